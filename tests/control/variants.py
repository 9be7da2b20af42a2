"""The reference designs with other gains or parameters, and their derivations, each computed once."""

from __future__ import annotations

import tempfile
from functools import lru_cache
from pathlib import Path

import numpy as np

from pbcgen import examples
from pbcgen.control.derive import Derivation, derive
from pbcgen.models.design import Design
from pbcgen.models.loader import load
from pbcgen.run.simulate import Trajectory, simulate_continuous

Changes = tuple[tuple[str, str], ...]

WITHOUT_FRICTION: Changes = (("d_1=5", "d_1=0"), ("d_2=1", "d_2=0"), ('d_3="0.2"', "d_3=0"))

_NATURAL = """NaturalDamping(
        alpha_c="2.5",
        beta_c=450,
        K_c="1e6",
        R_c="0.3",
        alpha_l="2.5",
        beta_l="2e6",
        K_l="5.5e-4",
        R_l=33,
    )"""
#: Scenario (i) of the coupling device: all of the 5 V in x_c, no x_l.
WITHOUT_X_L: Changes = (
    (_NATURAL, 'DynamicExtension(alpha=5, beta=450, K_c="1e6", R_c="0.3")'),
    ("NaturalDamping, Par", "DynamicExtension, Par"),
)


def coupling(alpha: str) -> Changes:
    """alpha_c = alpha_l = alpha."""
    return (
        ('alpha_c="2.5"', f'alpha_c="{alpha}"'),
        ('alpha_l="2.5"', f'alpha_l="{alpha}"'),
        ("symmetric(5)", "symmetric(10)"),
    )


def design(name: str, changes: Changes = ()) -> Design:
    """A reference design whose source is changed as a user would."""
    return _design(name, changes)


@lru_cache(maxsize=64)
def _design(name: str, changes: Changes) -> Design:
    sources = {name: examples.path(name).read_text(encoding="utf-8")}
    for other in examples.names():
        if f"from pbcgen.examples.{other} import" in sources[name]:
            sources[name] = sources[name].replace(f"from pbcgen.examples.{other} import", f"from {other} import")
            sources[other] = examples.path(other).read_text(encoding="utf-8")
    for before, after in changes:
        assert any(before in source for source in sources.values()), before
        sources = {file: source.replace(before, after) for file, source in sources.items()}
    with tempfile.TemporaryDirectory() as directory:
        for file, source in sources.items():
            (Path(directory) / f"{file}.py").write_text(source, encoding="utf-8")
        return load(str(Path(directory) / f"{name}.py"))


def derivation(name: str, changes: Changes = ()) -> Derivation:
    """Everything derived of it."""
    return _derivation(name, changes)


@lru_cache(maxsize=64)
def _derivation(name: str, changes: Changes) -> Derivation:
    return derive(design(name, changes))


def status(name: str, claim: str, changes: Changes = ()) -> str:
    """PROVED, REFUTED or UNDECIDED."""
    return str({c.claim: c for c in derivation(name, changes).claims}[claim].status)


@lru_cache(maxsize=16)
def continuous(name: str, changes: Changes = ()) -> Trajectory:
    """The continuous closed loop from the design's initial state."""
    loop = derivation(name, changes).loop
    assert loop is not None
    return simulate_continuous(loop, np.linspace(0, loop.duration, 20001))
