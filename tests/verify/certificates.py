"""Certificates to be checked, and ways to spoil them."""

import copy
import functools
import hashlib
import json
import re

import casadi as ca

from pbcgen import AffineSystem, Design, DynamicExtension, Limits, NaturalDamping, Parameters, PassiveOutput, load
from pbcgen.certify.certificate import certificate
from pbcgen.control.derive import derive
from pbcgen.models.identity import canonical_text
from pbcgen.verify.claims import examine
from pbcgen.verify.files import digest

#: Numbers that prove nothing, or that others could stand for: names of methods, the width of a box, the last digits of
#: its centre, a direction or a state in which a form is negative, which of the equations that say the same is taken.
IDLE = re.compile(
    r'"steps": \[[^"]*\[$|"method": "[^"]*$|"radius": "[^"]*$|"-?\d{60}\d*$|"rows": \[?$|"rows": \[\{"$'
    r'|"[vx]": \[[^]]*$'
)

REFERENCE = ("coupling_device", "rlc", "pera", "pera_integral")


def oscillator(**changes):
    """Two masses and two springs; mass 2 is damped, mass 1 is pushed. ``changes`` replace terms of the model."""
    p = Parameters(m=2, k="3/2", c="1/2", d="1/4")
    q1, q2, v1, v2, u = (ca.SX.sym(name) for name in ("q1", "q2", "p1", "p2", "u"))
    terms = {
        "spring": p.k * (q1 - q2),
        "wall": p.c * q1,
        "friction_1": p.d * v1 / p.m,
        "friction_2": p.d * v2 + ca.tanh(3 * v2),
        "coupling": 1,
        "energy": v1**2 / (2 * p.m) + v2**2 / 2 + p.k * (q1 - q2) ** 2 / 2 + p.c * q1**2 / 2,
        "push": 1,
    } | {name: change(p, q1, q2, v1, v2) for name, change in changes.items()}
    system = AffineSystem(
        x=[q1, q2, v1, v2],
        u=[u],
        f=[
            v1 / p.m,
            v2,
            -terms["spring"] - terms["wall"] - terms["friction_1"],
            terms["coupling"] * terms["spring"] - terms["friction_2"],
        ],
        g=[0, 0, terms["push"], 0],
        S=terms["energy"],
        parameters=p,
        measured=["q1", "q2"],
    )
    law = DynamicExtension(alpha=2, beta=1, K_c=1, R_c="1/2")
    return Design(system, target={"q1": "1/2"}, law=law, limits=Limits({"u": (-2, 3)}), sample_period="1e-2")


def damped_oscillator(K_l="10"):
    """The oscillator with natural damping of mass 2 in the law."""
    plain = oscillator()
    law = NaturalDamping(alpha_c=1, beta_c=1, K_c=1, R_c="1/2", alpha_l="1/2", beta_l=1, K_l=K_l, R_l=1)
    return Design(plain.system, target={"q1": "1/2"}, law=law, limits=Limits({"u": (-2, 3)}), sample_period="1e-2")


def fully_measured():
    """The oscillator with the law that measures its passive output."""
    plain = oscillator()
    law = PassiveOutput(alpha=1, beta=1, k_p="1/2")
    system = AffineSystem(
        x=plain.system.x,
        u=plain.system.u,
        f=plain.system.f,
        g=plain.system.g,
        S=plain.system.S,
        parameters=plain.system.parameters,
    )
    return Design(system, target={"q1": "1/2"}, law=law, limits=Limits({"u": (-2, 3)}), sample_period="1e-2")


@functools.cache
def _certificate(name):
    makers = {"oscillator": oscillator, "damped_oscillator": damped_oscillator, "fully_measured": fully_measured}
    return json.dumps(certificate(derive(makers[name]() if name in makers else load(name))))


def certificate_of(name):
    """A fresh copy of the certificate of a design."""
    return json.loads(_certificate(name))


def signed(document):
    """The document with the digest and the model's hash computed again, as a forger would."""
    document = copy.deepcopy(document)
    document["model_hash"] = hashlib.sha256("\n".join([*document["model"], ""]).encode()).hexdigest()
    return document | {"digest": digest(document)}


def forged(document, design, claims=None):
    """The certificate with another model under it, and every verdict PROVED."""
    document = copy.deepcopy(document)
    document["model"] = canonical_text(design).splitlines()
    for entry in document["claims"]:
        if claims is None or entry["claim"] in claims:
            entry["status"] = "PROVED"
    return signed(document)


def outcomes(document):
    """The outcome of each claim."""
    return {finding.claim: finding.outcome for finding in examine(document)}


def spoiled(document, part):
    """Every document in which one digit of ``part`` is another, with the place."""
    text = json.dumps(document[part])
    for match in re.finditer(r"\d", text):
        digit = str((int(match[0]) + 3) % 10)
        changed = text[: match.start()] + digit + text[match.end() :]
        try:
            yield f"{part}[{match.start()}]", signed(document | {part: json.loads(changed)})
        except ValueError:
            continue
