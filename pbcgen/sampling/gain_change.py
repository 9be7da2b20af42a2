"""The mildest change of gains that allows a wished sample period, decided by the certified spectral test."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

from pbcgen.models.exact import decimal
from pbcgen.models.laws import Integral, Law, PassiveOutput
from pbcgen.proof.claim import Status
from pbcgen.sampling.family import LoopFamily
from pbcgen.sampling.linearisation import Spectrum, spectral


@dataclass(frozen=True)
class GainChange:
    """Gains that the wished period allows, proved by the spectral route: each named gain times its factor."""

    factors: Mapping[str, Fraction]
    law: Law

    def __str__(self) -> str:
        return " and ".join(f"{gain} by {_plain(factor)}" for gain, factor in self.factors.items())


#: Ways to make a loop slower, as powers of one factor t < 1 for each gain. Amplitudes alpha stay, so do input ranges.
_MOVES: tuple[Mapping[str, int], ...] = (
    {"alpha*beta": 1},
    {"R_c": 1},
    {"R_c": -1},
    {"alpha*beta": 1, "R_c": -1},
    {"alpha*beta": 1, "K_c": -1},
)


def scaled(law: Law, factors: Mapping[str, Fraction]) -> Law:
    """The law with gains multiplied: ``alpha*beta`` stands for every beta of the base law, others for themselves."""
    if isinstance(law, Integral):
        return Integral(scaled(law.base, factors), law.alpha_psi, law.beta_psi, law.R_psi)  # type: ignore[arg-type]
    given = {**factors, **dict.fromkeys(("beta", "beta_c", "beta_l"), factors.get("alpha*beta", Fraction(1)))}
    copy = object.__new__(type(law))
    for key, value in law.__dict__.items():
        factor = given.get(key)
        object.__setattr__(copy, key, value if factor is None else _times(value, factor))
    return copy


def _times(value: Any, factor: Fraction) -> Any:
    return tuple(_times(v, factor) for v in value) if isinstance(value, tuple) else value * factor


def gain_change(
    family: LoopFamily,
    law: Law,
    h: Fraction,
    acceptable: Callable[[Law], bool] = lambda law: True,
    delay: Fraction = Fraction(0),
) -> GainChange | None:
    """The mildest change of alpha*beta, R_c or K_c by a common factor that is proved to allow the period h.

    Each factor that is tried is decided by the certified spectral test; ``acceptable`` may veto gains that break
    another claim.
    """
    best: tuple[Fraction, GainChange] | None = None
    tried = FACTORS if sum(family.loop(law).sizes[:2]) <= _LARGE else FACTORS[1::3]
    spectrum = Spectrum(family.A)
    for move in _MOVES:
        if isinstance(law, PassiveOutput) and set(move) != {"alpha*beta"}:
            continue

        def factors(t: Fraction, move: Mapping[str, int] = move) -> dict[str, Fraction]:
            return {gain: t**power for gain, power in move.items()}

        def good(t: Fraction, factors: Callable[[Fraction], dict[str, Fraction]] = factors) -> bool:
            candidate = scaled(law, factors(t))
            loop = family.loop(candidate)
            beyond = None if delay else spectrum.beyond(loop, h)
            worth = (beyond is None or beyond < _FAR) and acceptable(candidate)
            return worth and spectral(loop, h, delay).status is Status.PROVED

        milder = [t for t in tried if best is None or t > best[0]]
        t = next((t for t in milder if good(t)), None)  # each is tested: the good ones need not be an interval
        if t is not None:
            best = t, GainChange(factors(t), scaled(law, factors(t)))
    return None if best is None else best[1]


def _plain(value: Fraction) -> str:
    return decimal(value) if Fraction(f"{float(value):.6g}") == value else str(value)


#: Factors that are tried: 1/2 to 1/500 in short decimals, mildest first.
FACTORS = tuple(Fraction(n, 10**k) for k in (1, 2, 3) for n in ((8, 5, 4, 2) if k == 1 else (10, 8, 5, 4, 2)))
#: For loops with more states only every third of them is tried.
_LARGE = 50
#: Loops whose spectral radius is beyond one by more than this are not tried in balls, which takes much longer.
_FAR = 0.01
