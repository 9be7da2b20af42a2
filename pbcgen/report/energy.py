"""The closed-loop storage of a law as a numeric function, for plots."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from pbcgen.law.settings import column, matrix
from pbcgen.models.laws import Integral, NaturalDamping, PassiveOutput, PotentialCompensation, shaping

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pbcgen.control.derive import Derivation


def lyapunov(derivation: Derivation) -> ca.Function | None:
    """(x, xi) -> S_d - S_d(x*), or None where the law has no Lyapunov function or gamma is missing.

    S_d is that of the law: (Sd), (Sdc), with Phi_l for `natural-damping`, (Hdmec) for `potential-compensation`.
    """
    d = derivation
    if d.loop is not None and d.loop.lyapunov is not None:
        return _from_rest(d.loop.lyapunov, d)
    if d.graph is None or d.point is None or d.gamma is None or d.law is None or isinstance(d.law, Integral):
        return None
    system = d.plant.system
    xi = ca.SX.sym("xi", d.graph.xi.numel())
    total = _storage(d) + _filters(d, d.law, xi)
    symbols = d.plant.parameter_symbols
    values = np.array([float(v) for v in d.plant.parameter_values])
    at_values = ca.substitute(total, symbols, values) if len(values) else total
    return _from_rest(ca.Function("S_d", [system.x, xi], [at_values], ["x", "xi"], ["S_d"]), d)


def along(function: ca.Function, x: NDArray[np.float64], xi: NDArray[np.float64]) -> NDArray[np.float64]:
    """The function at the rows of x (N, n) and xi (N, nxi)."""
    return np.array(function.map(len(x))(x.T, xi.T)).ravel()


def _storage(d: Derivation) -> ca.SX:
    """What the shaping terms are added to: S + kappa^T gamma, or the kinetic energy where V is compensated."""
    mechanics = d.plant.system.mechanical
    if isinstance(d.law, PotentialCompensation) and mechanics is not None:
        return ca.dot(mechanics.p, mechanics.velocity) / 2
    kappa = ca.DM([float(v) for v in d.derived["kappa"]])
    assert d.gamma is not None
    return d.plant.system.S + ca.dot(ca.SX(kappa), d.gamma)


def _filters(d: Derivation, law: Any, xi: ca.SX) -> ca.SX:
    """Phi_c (or Phi), the spring of x_c, and Phi_l."""
    assert d.gamma is not None
    m = d.plant.system.m
    deviation = d.gamma - ca.SX(ca.DM([float(v) for v in d.derived["gamma_star"]]))
    if isinstance(law, PassiveOutput):
        return _phi(law.alpha, law.beta, deviation)
    x_c = xi[:m]
    term = shaping(law)
    total = _phi(term.alpha, term.beta, deviation + x_c) + ca.bilin(matrix(term.K_c or ()), x_c, x_c) / 2
    if not isinstance(law, NaturalDamping) or d.eta is None or d.point is None:
        return total
    at_rest = d.plant.at(d.point, d.eta)[0]
    shift = d.eta - ca.DM([float(row[0]) for row in at_rest])
    K_l = column([law.K_l[i][i] for i in range(m)])
    return total + _phi(law.alpha_l, law.beta_l, ca.mtimes(matrix(law.Upsilon or ()), shift) + K_l * xi[m:])


def _phi(alpha: Any, beta: Any, z: ca.SX) -> ca.SX:
    """sum alpha/beta ln cosh(beta z) (Phi), in the form that does not overflow."""
    a, b = column(alpha), column(beta)
    size = ca.fabs(b * z)
    return ca.dot(a / b, size + ca.log1p(ca.exp(-2 * size)) - np.log(2.0))


def _from_rest(function: ca.Function, d: Derivation) -> ca.Function:
    assert d.loop is not None
    x, xi = ca.SX.sym("x", function.size1_in(0)), ca.SX.sym("xi", function.size1_in(1))
    rest = float(function(d.loop.x_star, np.zeros(xi.numel())))
    return ca.Function("S_d", [x, xi], [function(x, xi) - rest], ["x", "xi"], ["S_d"])
