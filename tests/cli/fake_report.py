"""A report with every kind of verdict, for tests that look at how it is printed and not at how it is found."""

from fractions import Fraction

from pbcgen.models.loader import load
from pbcgen.pipeline import Report
from pbcgen.proof.claim import CLAIMS, Claim, Status

GLOBAL = "globally-asymptotically-stable"
LONG = "the interval [3.003, 3.1] of u lies in [0, 3.1]; the upper bound is touched, which the clamp allows for " * 2


def claim(name: str, status: Status = Status.PROVED) -> Claim:
    refuted = status is Status.REFUTED
    domains = {"stable": "x1 in [-1/10, 1/10], x2 in [-1/10, 1/10], x3 in [0, 4]", GLOBAL: "all x"}
    return Claim(
        name,
        status,
        domain=domains.get(name, "at x*"),
        method="exact algebra",
        evidence=LONG,
        hint="" if status is Status.PROVED else "raise alpha above [1/20] or widen the limits",
        counterexample={"x": ["1/3"]} if refuted else None,
    )


def report(*, writable: bool = True, **statuses: Status) -> Report:
    """A report on `rlc`; ``theta=Status.REFUTED`` changes a verdict (with _ for -)."""
    named = {name.replace("_", "-"): status for name, status in statuses.items()}
    return Report(
        design=load("rlc"),
        claims=tuple(claim(name, named.get(name, Status.PROVED)) for name in CLAIMS),
        derived={
            "kappa": ["-3.0515"],
            "gamma": ["x3/L1"],
            "gamma_star": [305.15],
            "eta": [],
            "x_star": [0.0505, 0.030515, 3.0515],
            "hessian_min_eigenvalue": 12.3456789,
            "alpha_beta_min": None,
            "kc_min": [["1/2", "0"], ["0", 1.5]],
            "theta_bound": None,
            "input_intervals": [[Fraction("3.003"), Fraction("3.1")]],
            "spectral_abscissa": float("nan"),
            "max_sample_period": 3.8e-4,
        },
        unfitted="a law" if writable else None,  # type: ignore[arg-type]
        loop=None,
        model_hash="0" * 64,
        timings={"derive": 0.5},
        derivation=None,  # type: ignore[arg-type]
    )
