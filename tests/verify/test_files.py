"""Certificates and packages as files, and the command `pbcgen verify`."""

import functools
import hashlib
import json
import re

import pytest
from certificates import REFERENCE, certificate_of, oscillator, signed

from pbcgen import pipeline
from pbcgen.cli import execute
from pbcgen.symbolic.plain.outcomes import Malformed
from pbcgen.verify.files import read, verify


@pytest.fixture(scope="module")
def package(tmp_path_factory):
    directory = tmp_path_factory.mktemp("package") / "c"
    pipeline.generate(oscillator(), directory, prefix="osc")
    return {str(path.relative_to(directory)): path.read_bytes() for path in directory.rglob("*") if path.is_file()}


@pytest.fixture
def directory(package, tmp_path):
    for name, content in package.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(content)
    return tmp_path


def outcome(directory):
    return {finding.claim: finding for finding in verify(directory)[1]}["package"]


def test_a_generated_package_is_accepted(directory, capsys):
    assert outcome(directory).outcome == "checked"
    assert execute(["verify", str(directory)]) == 0
    assert "Accepted." in capsys.readouterr().out


def test_any_changed_digit_of_the_file_is_noticed(directory):
    path = directory / "certificate.json"
    text = path.read_text()
    digits = [k for k, c in enumerate(text) if c.isdigit()]
    for k in digits[:: len(digits) // 300]:
        path.write_text(text[:k] + str((int(text[k]) + 1) % 10) + text[k + 1 :])
        with pytest.raises(Malformed):
            read(path)


def _paths(value, at=()):
    """Where numbers stand in a document: the path, and the text that holds digits."""
    if isinstance(value, dict):
        for key, entry in value.items():
            yield from _paths(entry, (*at, key))
    elif isinstance(value, list):
        for k, entry in enumerate(value):
            yield from _paths(entry, (*at, k))
    elif not isinstance(value, bool) and re.search(r"\d", str(value)):
        yield at, value


def _changed(value):
    if isinstance(value, int):
        return value + 1
    return re.sub(r"\d", lambda m: str((int(m[0]) + 1) % 10), value, count=1)


@pytest.mark.parametrize("name", REFERENCE)
def test_a_changed_number_at_any_place_of_the_document_is_noticed(name, tmp_path):
    document = certificate_of(name)
    path, places = tmp_path / "c.json", list(_paths(document))
    assert len(places) > 150
    for at, value in places:
        *parents, last = at
        holder = functools.reduce(lambda part, key: part[key], parents, document)
        holder[last] = _changed(value)
        path.write_text(json.dumps(document))
        with pytest.raises(Malformed):
            read(path)
        holder[last] = value
    path.write_text(json.dumps(document))
    read(path)


def test_a_certificate_beside_its_package_is_tied_to_the_header(directory, capsys):
    certificate, header = directory / "certificate.json", directory / "osc.h"
    assert execute(["verify", str(certificate)]) == 0
    assert "package" in capsys.readouterr().out
    text, manifest = header.read_text(), json.loads((directory / "manifest.json").read_text())
    stated = manifest["model_hash"]
    header.write_text(text.replace(stated, "0" * 64))
    manifest["files"]["osc.h"]["sha256"] = hashlib.sha256(header.read_bytes()).hexdigest()
    (directory / "manifest.json").write_text(json.dumps(manifest))
    assert execute(["verify", str(certificate)]) == 2
    assert "osc.h does not name the model" in " ".join(capsys.readouterr().out.split())


def test_a_changed_source_file_is_noticed(directory, capsys):
    path = directory / "osc.c"
    path.write_text(path.read_text().replace("return", "return ", 1))
    assert outcome(directory).outcome == "fails"
    assert execute(["verify", str(directory)]) == 2
    assert "osc.c" in capsys.readouterr().out


def test_the_manifest_must_speak_of_the_same_model_and_verdicts(directory):
    path = directory / "manifest.json"
    manifest = json.loads(path.read_text())
    path.write_text(json.dumps(manifest | {"model_hash": "0" * 64}))
    assert "another model" in outcome(directory).reason
    manifest["verdicts"][0]["status"] = "UNDECIDED"
    path.write_text(json.dumps(manifest))
    assert "other verdicts" in outcome(directory).reason
    path.unlink()
    assert outcome(directory).outcome == "fails"


def test_a_model_that_its_hash_does_not_name_is_refused(tmp_path):
    document = certificate_of("oscillator")
    forged = signed(document)
    forged["model"][0] += " "
    path = tmp_path / "certificate.json"
    path.write_text(json.dumps(forged))
    with pytest.raises(Malformed, match="digest"):
        read(path)
    forged = signed(document | {"format": 2})
    path.write_text(json.dumps(forged))
    with pytest.raises(Malformed, match="format"):
        read(path)


@pytest.mark.parametrize("text", ["", "{", "[]", "{}", '{"format": 1}', '{"format": 1, "model": []}', "\x00"])
def test_what_is_no_certificate_ends_with_exit_code_1(text, tmp_path, capsys):
    path = tmp_path / "file.json"
    path.write_text(text)
    assert execute(["verify", str(path)]) == 1
    assert "Error:" in capsys.readouterr().err
    assert execute(["verify", str(tmp_path / "absent.json")]) == 1


def test_a_claim_that_does_not_hold_ends_with_exit_code_2(tmp_path, capsys):
    document = certificate_of("oscillator")
    document["claims"][2]["witness"] = {"squares": []}
    path = tmp_path / "c.json"
    path.write_text(json.dumps(signed(document)))
    assert execute(["verify", str(path), "--json"]) == 2
    found = json.loads(capsys.readouterr().out)
    assert found["accepted"] is False
    assert {f["claim"]: f["outcome"] for f in found["findings"]}["assumption-1"] == "fails"


def test_strict_does_not_accept_what_is_only_recorded(tmp_path, capsys):
    document = certificate_of("oscillator")
    document["claims"][2]["witness"] = None
    path = tmp_path / "c.json"
    path.write_text(json.dumps(signed(document)))
    assert execute(["verify", str(path)]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    recorded = int(re.search(r"(\d+) recorded and NOT checked", shown)[1])
    assert recorded >= 1
    assert f"Accepted, but for {recorded} that nothing here checked" in shown
    assert execute(["verify", str(path), "--strict"]) == 2


@pytest.mark.parametrize("spoil", [
    lambda d: d["terms"].__setitem__(0, []),
    lambda d: d["readings"].__setitem__(0, None),
    lambda d: d["formulas"].__setitem__(0, 3),
    lambda d: d["claims"].__setitem__(0, "PROVED"),
    lambda d: d["claims"][3].update(status={}),
    lambda d: d["claims"][3].update(claim=1),
    lambda d: d["claims"][3].pop("witness"),
    lambda d: d["claims"][3].pop("domain"),
])  # fmt: skip
def test_a_signed_document_of_other_kinds_of_entries_is_refused_in_words(spoil, tmp_path, capsys):
    document = certificate_of("oscillator")
    spoil(document)
    (tmp_path / "c.json").write_text(json.dumps(signed(document)))
    assert execute(["verify", str(tmp_path / "c.json")]) == 1
    assert "entries of another kind" in capsys.readouterr().err
