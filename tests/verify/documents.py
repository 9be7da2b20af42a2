"""Certificates of the designs as documents, and what they hold for a claim."""

import copy
import functools
import json

from certificates import certificate_of, signed
from designs import DESIGNS

from pbcgen.certify.certificate import certificate
from pbcgen.control.derive import derive

GLOBAL, LOCAL, SAMPLED = "globally-asymptotically-stable", "asymptotically-stable", "sampled-stable"


@functools.cache
def _written(name):
    return json.dumps(certificate(derive(DESIGNS[name]())))


def document_of(name):
    return json.loads(_written(name)) if name in DESIGNS else certificate_of(name)


def witness(document, claim):
    return next(entry["witness"] for entry in document["claims"] if entry["claim"] == claim)


def status(document, claim):
    return next(entry["status"] for entry in document["claims"] if entry["claim"] == claim)


def with_witness(document, claim, **changes):
    """The document with parts of a witness replaced."""
    document = copy.deepcopy(document)
    for entry in document["claims"]:
        if entry["claim"] == claim:
            entry["witness"] = {**(entry["witness"] or {}), **changes}
    return signed(document)


def written_for(design):
    return json.loads(json.dumps(certificate(derive(design))))
