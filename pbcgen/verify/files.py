"""Certificates and packages as files."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pbcgen.symbolic.plain.outcomes import Malformed, require
from pbcgen.verify.claims import Finding, examine

FORMAT = 1
CERTIFICATE, MANIFEST = "certificate.json", "manifest.json"

_VERDICT = ("claim", "status", "domain")
_LISTS = ("model", "formulas", "readings", "terms", "claims")


def digest(document: Mapping[str, Any]) -> str:
    """SHA-256 of the canonical text of everything but the digest itself."""
    rest = {key: value for key, value in document.items() if key != "digest"}
    return hashlib.sha256(json.dumps(rest, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def verify(path: Path) -> tuple[Mapping[str, Any], list[Finding]]:
    """Check a certificate; with it the files of the package that it stands in, if there is a manifest.

    Raises Malformed for what is no certificate, or has been changed since it was written.
    """
    directory = path if path.is_dir() else path.parent
    document = read(path / CERTIFICATE if path.is_dir() else path)
    package = path.is_dir() or (path.name == CERTIFICATE and (directory / MANIFEST).exists())
    return document, ([_package(directory, document)] if package else []) + examine(document)


def read(path: Path) -> dict[str, Any]:
    """The certificate in a file. Raises Malformed."""
    try:
        document: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise Malformed(f"{path} cannot be read: {error}") from None
    known = isinstance(document, dict) and document.get("format") == FORMAT
    require(known, f"{path} is not a certificate of format {FORMAT}", Malformed)
    require(all(isinstance(document.get(name), list) for name in _LISTS), f"{path} is not complete", Malformed)
    same = document.get("digest") == digest(document)
    require(same, f"{path} was changed: it does not have the digest that it states", Malformed)
    hashed = hashlib.sha256("\n".join([*document["model"], ""]).encode()).hexdigest()
    require(document.get("model_hash") == hashed, f"{path} does not hold the model that its hash names", Malformed)
    return document


def _package(directory: Path, document: Mapping[str, Any]) -> Finding:
    """Whether the files are those of the manifest, and the manifest speaks of the same model and verdicts."""
    try:
        manifest = json.loads((directory / MANIFEST).read_text(encoding="utf-8"))
        sums = {name: hashlib.sha256((directory / name).read_bytes()).hexdigest() for name in manifest["files"]}
        changed = [name for name, facts in manifest["files"].items() if sums[name] != facts["sha256"]]
        both, model = (manifest["verdicts"], document["claims"]), document["model_hash"]
        verdicts, stated = ([[v[k] for k in _VERDICT] for v in part] for part in both)
        same, headers = manifest["model_hash"] == model, [name for name in sums if name.endswith(".h")]
        strange = [name for name in headers if model not in (directory / name).read_text("utf-8")]
    except (OSError, ValueError, LookupError, TypeError) as error:
        return Finding("package", "", "fails", f"{MANIFEST} or a file that it lists cannot be read: {error}")
    reasons = [f"changed since they were generated: {', '.join(changed)}"] if changed else []
    reasons += [] if CERTIFICATE in sums else [f"the manifest does not list {CERTIFICATE}"]
    reasons += [f"{name} does not name the model of the certificate" for name in strange]
    reasons += [] if same else ["the manifest names another model than the certificate"]
    reasons += [] if verdicts == stated else ["the manifest states other verdicts than the certificate"]
    return Finding("package", "", "fails" if reasons else "checked", "; ".join(reasons))
