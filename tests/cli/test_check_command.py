"""What `pbcgen check` prints, told from a report that is made up."""

import json
import re

import fake_report
import pytest

from pbcgen import cli, pipeline
from pbcgen.proof.claim import CLAIMS, EMISSION_CLAIMS, Status

PROVED, REFUTED, UNDECIDED = Status.PROVED, Status.REFUTED, Status.UNDECIDED


@pytest.fixture
def check(monkeypatch, capsys):
    """Run the command on a made-up report at a width; returns exit code and standard output."""

    def _check(*arguments, width=80, **verdicts):
        monkeypatch.setenv("COLUMNS", str(width))
        monkeypatch.setattr(pipeline, "check", lambda design, progress, scan: fake_report.report(**verdicts))
        code = cli.execute(["check", "rlc", *arguments])
        return code, capsys.readouterr().out

    return _check


@pytest.mark.parametrize("width", [40, 80, 120, 200])
def test_the_report_fits_the_terminal_and_the_page(check, width):
    text = check(width=width, theta=REFUTED, stable=UNDECIDED)[1]
    printed = [line.rstrip() for line in text.splitlines() if not line.startswith("Next:")]
    assert max(map(len, printed)) <= min(width, 100)
    assert "hint:" in text


def test_every_verdict_says_claim_status_domain_and_why(check):
    text = check(stable=UNDECIDED)[1]
    for name in CLAIMS:
        assert re.search(rf"^(PROVED|UNDECIDED|) +{name} ", text, re.MULTILINE), name
    assert "at x*" in text
    assert "exact algebra: the interval" in text
    assert text.count("hint: raise alpha above [1/20] or widen the limits") == 1


def test_derived_quantities_stand_below(check):
    text = check()[1]
    for expected in (
        r"x\* +x1 = 0.0505, x2 = 0.030515, x3 = 3.0515",
        r"kappa +-3.0515",
        r"gamma +x3/L1",
        r"least Hessian eigenvalue +12.3457",
        r"K_c must exceed +\[1/2, 0\], \[0, 1.5\]",
        r"u is always in +\[3.003, 3.1\]",
        r"largest sample period \[s\] +0.00038",
    ):
        assert re.search(expected, text), expected
    assert "None" not in text
    assert "alpha beta" not in text


def test_what_is_proved_ends_with_the_command_that_generates(check):
    code, text = check()
    assert code == 0
    assert "Proved: the loop settles at x* from everywhere, sampled from nearby" in text
    assert text.rstrip().endswith("Next: pbcgen generate rlc -o rlc_c")


def test_a_local_proof_does_not_claim_more(check):
    code, text = check(globally_asymptotically_stable=UNDECIDED)
    assert code == 0
    assert "from nearby the loop settles" in text
    assert "everywhere" not in text


@pytest.mark.parametrize("status", [REFUTED, UNDECIDED])
def test_a_claim_that_blocks_code_exits_with_2_and_names_itself(check, status):
    code, text = check(saturation=status, sampled_stable=status)
    assert code == 2
    printed = " ".join(text.split())
    assert f"(saturation {status})" in printed
    assert f"(sampled-stable {status})" in printed
    assert ("--allow saturation --allow sampled-stable" in text) is (status is UNDECIDED)


def test_what_is_refuted_is_named_before_what_it_leaves_open(check):
    text = check(saturation=REFUTED, sampled_stable=UNDECIDED)[1]
    assert "No code: the inputs can leave their limits (saturation REFUTED)." in text


def test_a_hint_that_claims_share_is_given_once(check):
    assert check(saturation=REFUTED, sampled_stable=UNDECIDED)[1].count("hint: ") == 1


def test_a_claim_that_code_does_not_need_does_not_block(check):
    code, text = check(theta=REFUTED)
    assert code == 0
    assert re.search(r"^REFUTED +theta", text, re.MULTILINE)
    assert "Next: pbcgen generate" in text


def test_a_derivation_that_stopped_offers_no_way_round(check):
    code, text = check(writable=False, equilibrium=REFUTED)
    assert code == 2
    assert "--allow" not in text
    code, text = check(writable=False)
    assert code == 2
    assert "No code: the derivation stopped" in text


@pytest.mark.parametrize("saturation", [PROVED, REFUTED])
def test_json_is_one_document_with_the_fixed_keys(check, saturation):
    code, text = check("--json", saturation=saturation)
    assert code == (0 if saturation is PROVED else 2)
    document = json.loads(text)
    assert list(document) == ["design", "law", "claims", "derived", "emittable", "timings"]
    for entry in document["claims"]:
        assert list(entry) == ["claim", "status", "domain", "method", "evidence", "hint", "counterexample"]
    assert [entry["claim"] for entry in document["claims"]] == list(CLAIMS)
    assert set(document["derived"]) == {
        "kappa",
        "gamma",
        "gamma_star",
        "eta",
        "x_star",
        "hessian_min_eigenvalue",
        "alpha_beta_min",
        "kc_min",
        "theta_bound",
        "input_intervals",
        "spectral_abscissa",
        "max_sample_period",
    }
    assert document["emittable"] is (saturation is PROVED)
    assert document["derived"]["spectral_abscissa"] is None


def test_brackets_in_evidence_are_no_markup(check):
    assert "[3.003, 3.1]" in check()[1]


def test_what_libraries_print_does_not_reach_the_document(monkeypatch, capsys):
    def noisy(design, progress, scan):
        print("a warning from a library")
        return fake_report.report()

    monkeypatch.setattr(pipeline, "check", noisy)
    assert cli.execute(["check", "rlc", "--json"]) == 0
    captured = capsys.readouterr()
    json.loads(captured.out)
    assert "a warning" in captured.err


def test_every_claim_that_code_needs_has_words_for_its_absence():
    from pbcgen.report.page import MEANINGS
    from pbcgen.report.sentence import WITHOUT

    assert set(EMISSION_CLAIMS) <= set(WITHOUT)
    assert set(CLAIMS) <= set(MEANINGS)
