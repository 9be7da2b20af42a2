"""The page holds everything, is complete in itself, and is the same every time."""

import json
import re
from html.parser import HTMLParser

import casadi as ca
import pytest
from shown_designs import circuit, circuit_page, refused

from pbcgen import AffineSystem, Design, DynamicExtension, Parameters, pipeline
from pbcgen.control.attraction import Region
from pbcgen.control.derive import derive
from pbcgen.models.loader import load
from pbcgen.proof.claim import Status
from pbcgen.report.derivation import steps
from pbcgen.report.mathematics import mathml
from pbcgen.report.page import page, prototypes

pytestmark = pytest.mark.system


class Elements(HTMLParser):
    """All start tags of a page with their attributes, and the tags that were left open."""

    VOID = frozenset({"meta", "link", "br", "line", "mspace"})

    def __init__(self, text):
        super().__init__()
        self.found, self.open = [], []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.found.append((tag, dict(attributes)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.found.append((tag, dict(attributes)))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag, tag


def test_two_pages_of_one_design_are_equal():
    report, package = circuit()
    assert page(report, package) == circuit_page()


def test_every_element_is_closed_and_nothing_outside_is_needed():
    elements = Elements(circuit_page())
    assert elements.open == []
    for tag, attributes in elements.found:
        for name in ("src", "href", "action", "data"):
            target = attributes.get(name)
            assert target is None or target.startswith(("#", "data:")), f"<{tag} {name}={target}>"
    assert "@import" not in circuit_page()


def test_links_inside_the_page_lead_somewhere():
    elements = Elements(circuit_page())
    anchors = {attributes["id"] for _, attributes in elements.found if "id" in attributes}
    assert {a["href"][1:] for t, a in elements.found if t == "a"} <= anchors


def test_every_verdict_has_its_word_and_its_sign():
    text = circuit_page()
    report, _ = circuit()
    for claim in report.claims:
        row = re.search(rf'id="claim-{claim.claim}".*?</tr>', text, re.DOTALL).group()
        assert f"</span> {claim.status.value}</span>" in row
    assert "✓" in text


def test_hashes_and_files_are_those_of_the_package():
    report, package = circuit()
    text = circuit_page()
    assert report.model_hash in text
    manifest = json.loads(package.files["manifest.json"])
    for entry in manifest["files"].values():
        assert entry["sha256"] in text
    assert manifest["files"]["certificate.json"]["sha256"] in re.search("<dt>Certificate.*?</dd>", text, re.DOTALL)[0]


def test_tables_have_headers_and_pictures_have_words():
    elements = Elements(circuit_page())
    assert all("scope" in a for t, a in elements.found if t == "th")
    pictures = [a for _, a in elements.found if a.get("role") == "img"]
    assert len(pictures) >= 4
    assert all(len(a["aria-label"]) > 20 and a["tabindex"] == "0" for a in pictures)


def test_the_derivation_names_its_equations():
    for name in ("pascond", "ypas", "hesscond", "dxc", "uc", "dSdc", "kappa"):
        assert name in circuit_page(), name


def test_the_chain_of_lasalle_is_written_out():
    report, _ = circuit()
    (stability,) = (step for step in steps(report.derivation) if step.key == "stability")
    (chain,) = (f.latex for f in stability.formulas if f.caption.startswith("LaSalle"))
    assert r"x_{2} = " in chain
    assert r"\implies" in chain


def test_the_page_stays_small():
    assert len(circuit_page().encode()) < 500_000


def test_a_refused_design_has_a_page_that_says_why():
    report = refused()
    text = page(report, None)
    assert "No code: the loop does not settle at x* (asymptotically-stable REFUTED)." in text
    assert Status.REFUTED in {c.status for c in report.claims}
    assert "Counterexample:" in text
    assert 'id="package"' not in text


def test_an_allowed_claim_is_named_in_the_page():
    report = refused()
    if report.control is None:
        pytest.skip("there is no law to allow")
    allowed = tuple(c.claim for c in report.blocking())
    text = page(report, pipeline.package(report, allow=allowed))
    for claim in allowed:
        assert f"NOT PROVED ({claim}), allowed by the user" in text


def test_two_designs_can_be_compared():
    report, package = circuit()
    earlier = pipeline.check(load("rlc").with_(law=report.design.law.__class__("0.02", 1, 10, 10), duration="0.05"))
    text = page(report, package, before=earlier)
    assert "Before and after" in text
    assert "gain alpha" in text
    data = json.loads(re.search(r'id="plot-data">(.*?)</script>', text, re.DOTALL)[1])
    assert "before x2" in data["columns"]
    assert all(len(c) == len(data["times"]) for c in data["columns"].values())


def test_a_region_of_attraction_is_stated_and_drawn():
    report, package = circuit()
    names = report.loop.state_names
    centre, radii = report.loop.x_star, [0.2, 0.2, 4.0]
    box = {n: (c - r, c + r) for n, c, r in zip(names, centre, radii, strict=True)}

    def height(x):
        return sum(((v - c) / r) ** 2 for v, c, r in zip(x, centre, radii, strict=True))

    region = Region(Status.PROVED, 0.81, box, "for this test", height, height)
    text = page(report, package, region=region)
    assert "Region of attraction" in text
    assert "The initial state of the design, with the filters at zero, is inside" in text
    (portrait, *_) = json.loads(re.search(r'id="plot-data">(.*?)</script>', text, re.DOTALL)[1])["portraits"]
    ((xs, _),) = portrait["region"]
    i = names.index("x3")
    assert max(xs) == pytest.approx(centre[i] + 0.9 * radii[i], abs=1e-3)
    assert portrait["x_range"][1] > max(xs), "the whole outline is in the picture"


def test_functions_arrows_norms_and_signs_are_set_as_in_a_book():
    assert mathml(r"\frac{a}{b} \ln\cosh(x)").count('<mspace width="0.17em"/>') == 2
    assert '<mo lspace="0.3em"' in mathml(r"a \iff b")
    assert "<mi>&#x027" not in mathml(r"a \implies b")
    assert mathml(r"\lVert x \rVert^2").count('stretchy="false"') == 2
    assert '<mo form="prefix">' in mathml("u = -k")
    assert "form=" not in mathml("u - k")


def test_the_functions_of_the_header_are_shown():
    _, package = circuit()
    found = prototypes(package)
    assert "void rlc_init(rlc_state_t *state);" in found
    assert all(text in circuit_page() for text in found)


def test_the_feedthrough_of_the_output_is_stated():
    latex = {f.caption: f.latex for s in steps(circuit()[0].derivation) for f in s.formulas}
    assert latex["Feedthrough of the output: y contains w^T w u (ypas)"].endswith("= 0")


def test_no_lyapunov_function_is_stated_without_a_passive_output():
    """A synchronous motor loses power at the target; the linearisation alone proves the loop."""
    i_d, i_q, w, v_d, v_q = (ca.SX.sym(name) for name in ("i_d", "i_q", "w", "v_d", "v_q"))
    p = Parameters(L="8e-3", R="1.2", psi="0.48", n=4, J="1e-3", b="2e-3")
    coils = [-p.R / p.L * i_d + p.n * w * i_q, -p.R / p.L * i_q - p.n * w * i_d - p.psi / p.L * w]
    S = p.L * (i_d**2 + i_q**2) / 2 + p.J * w**2 / 2
    g = [[1 / p.L, 0], [0, 1 / p.L], [0, 0]]
    motor = AffineSystem([i_d, i_q, w], [v_d, v_q], [*coils, (p.psi * i_q - p.b * w) / p.J], g, S, parameters=p)
    law = DynamicExtension(alpha=10, beta=1, K_c=5, R_c=1)
    found = derive(Design(motor, {"w": 100, "i_d": 0}, law, sample_period="1e-4"))
    verdicts = {claim.claim: claim.status for claim in found.claims}
    assert verdicts["passive-output"] is not Status.PROVED
    assert verdicts["asymptotically-stable"] is Status.PROVED
    captions = {formula.caption for step in steps(found) for formula in step.formulas}
    assert "Tried" in captions
    assert not captions & {"Lyapunov function", "Its rate along the closed loop", "Passive output (ypas)"}


def test_the_loss_of_a_circuit_is_a_short_sum_in_the_rates():
    (step,) = (step for step in steps(derive(load("rlc"))) if step.key == "storage")
    (loss,) = (formula.latex for formula in step.formulas if formula.caption.startswith("Dissipation"))
    assert loss.endswith(r"= r \dot{x}_{2}^2 + \frac{a\,e^{\frac{x_{3}}{b}}}{b} \dot{x}_{3}^2, \quad \dot x = f")
