"""Electrical circuits in Brayton-Moser form (BMe)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import casadi as ca

from pbcgen.errors import ModelError
from pbcgen.models.affine import AffineSystem, Brayton, IntervalLike, MeasuredLike, Structure
from pbcgen.models.expressions import (
    check_finite,
    check_symbols,
    depends,
    expression,
    names,
    never_positive_definite,
    shaped,
    square,
    symbols,
    vanishes_at_samples,
)
from pbcgen.models.inertia import inverse, named_constants
from pbcgen.models.mechanical import input_symbols
from pbcgen.models.numbers import named
from pbcgen.models.parameters import Parameters

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence


@dataclass(frozen=True, eq=False, init=False)
class Circuit:
    """A topologically complete circuit with state (i_L, v_C):

        -L i_L' = Gamma v_C + v_R(i_L) + g_L u_L
         C v_C' = Gamma^T i_L - i_G(v_C) + g_C u_C

    A voltage source that drives current i into its inductor therefore has g_L = -1.

    Attributes:
        i_L: currents of the inductors.
        v_C: voltages of the capacitors.
        u: voltage sources u_L, then current sources u_C.
        parts: Q, P, its gradient and Hessian, Xi, Q_tilde, g_tilde of Prop. pro:rcl.
        system: the input-affine system with storage P_tilde.
    """

    i_L: ca.SX
    v_C: ca.SX
    u: ca.SX
    parts: Brayton
    system: AffineSystem

    def __init__(
        self,
        i_L: Any,
        v_C: Any,
        *,
        L: Any,
        C: Any,
        Gamma: Any = None,
        v_R: Any = None,
        i_G: Any = None,
        P_R: Any = None,
        P_G: Any = None,
        g_L: Any = None,
        g_C: Any = None,
        parameters: Parameters | None = None,
        inputs: Sequence[str] | None = None,
        domain: Mapping[str, IntervalLike] | None = None,
        gamma: Any = None,
        eta: Any = None,
        measured: MeasuredLike | None = None,
        units: Mapping[str, str] | None = None,
        name: str = "",
    ) -> None:
        """Check and store the circuit.

        Args:
            i_L: currents of the inductors, k SX symbols.
            v_C: voltages of the capacitors, c SX symbols.
            L: inductances, symmetric k x k, or the list of its diagonal.
            C: capacitances, symmetric c x c, or the list of its diagonal.
            Gamma: interconnection, k x c; zero if not given.
            v_R: voltages of the current-controlled resistors as functions of i_L, k x 1.
            i_G: currents of the voltage-controlled resistors as functions of v_C, c x 1.
            P_R: the potential of v_R, instead of v_R.
            P_G: the potential of i_G, instead of i_G.
            g_L: k x m_L input matrix of the voltage sources.
            g_C: c x m_C input matrix of the current sources.
            parameters: the constants that occur.
            inputs: names of the inputs, voltage sources first; ``u_1, u_2, ...`` if not given.
            domain: (lo, hi) by state name.
            gamma: known gamma(x), m entries.
            eta: known eta(x).
            measured: state names and/or named expressions; all states if not given.
            units: units by name.
            name: how reports call the system.

        Raises:
            ModelError: for wrong shapes or symbols, L or C not symmetric or not constant, a v_R or i_G that is no
                gradient, a law and its potential both given, no source at all.
        """
        i_L, v_C = symbols(i_L, "the currents i_L"), symbols(v_C, "the voltages v_C")
        parameters = parameters if parameters is not None else Parameters()
        inductance = _storage(L, i_L, "the inductance L", parameters)
        capacitance = _storage(C, v_C, "the capacitance C", parameters)
        inductance, parameters = named_constants(inductance, "L", parameters)
        capacitance, parameters = named_constants(capacitance, "C", parameters)
        taken = [*names(i_L), *names(v_C), *([inputs] if isinstance(inputs, str) else inputs or [])]
        v_R, parameters = _named(v_R, (i_L.numel(), 1), "v_R", parameters, taken)
        P_R, parameters = _named(P_R, (1, 1), "P_R", parameters, taken)
        i_G, parameters = _named(i_G, (v_C.numel(), 1), "i_G", parameters, taken)
        P_G, parameters = _named(P_G, (1, 1), "P_G", parameters, taken)
        coupling, parameters = named(_interconnection(Gamma, i_L, v_C, parameters), "Gamma", parameters, taken)
        parts = _brayton(
            i_L,
            v_C,
            storage=(inductance, capacitance),
            Gamma=coupling,
            resistive=_resistive(v_R, P_R, i_L, ("v_R", "P_R"), parameters),
            conductive=_resistive(i_G, P_G, v_C, ("i_G", "P_G"), parameters),
            g_tilde=_sources(g_L, g_C, i_L, v_C, parameters),
        )
        u = input_symbols(inputs, parts.g_tilde.shape[1])
        system = _affine(
            parts,
            ca.vertcat(i_L, v_C),
            u,
            parameters=parameters,
            domain=domain,
            gamma=gamma,
            eta=eta,
            measured=measured,
            units=units,
            name=name,
        )
        for key, value in {"i_L": i_L, "v_C": v_C, "u": u, "parts": parts, "system": system}.items():
            object.__setattr__(self, key, value)

    def lower(self) -> AffineSystem:
        """The circuit as ``x' = f + g u`` with S = P_tilde and ``grad S = Q_tilde f`` (RLCaff)."""
        return self.system


def _storage(value: Any, variables: ca.SX, what: str, parameters: Parameters) -> ca.SX:
    """An inductance or capacitance matrix: constant and symmetric."""
    matrix = ca.sparsify(square(value, variables.numel(), what))
    check_symbols(matrix, (parameters.symbols,), what, variables, "the state")
    check_finite(matrix, what)
    if ca.sprank(matrix) < variables.numel():
        raise ModelError(f"{what} is singular: its nonzero entries leave a row without partner")
    if not _symmetric(matrix, variables, parameters):
        raise ModelError(f"{what} is not symmetric")
    if never_positive_definite(matrix, variables, parameters.symbols, parameters.numeric):
        raise ModelError(f"{what} is not positive definite: look for a negative value, or a coupling that is too large")
    return matrix


def _symmetric(matrix: ca.SX, variables: ca.SX, parameters: Parameters) -> bool:
    difference, scale = matrix - matrix.T, ca.norm_fro(matrix)
    return vanishes_at_samples(difference, scale, variables, parameters.symbols, parameters.numeric)


def _interconnection(Gamma: Any, i_L: ca.SX, v_C: ca.SX, parameters: Parameters) -> ca.SX:
    shape = (i_L.numel(), v_C.numel())
    matrix = ca.SX(*shape) if Gamma is None else ca.sparsify(shaped(Gamma, shape, "the interconnection Gamma"))
    check_symbols(matrix, (parameters.symbols,), "the interconnection Gamma", ca.vertcat(i_L, v_C), "the state")
    check_finite(matrix, "the interconnection Gamma")
    return matrix


def _named(
    law: Any, shape: tuple[int, int], label: str, parameters: Parameters, taken: Sequence[str]
) -> tuple[Any, Parameters]:
    """A resistive law or potential with its numbers as parameters, so that its derivatives are exact."""
    return (None, parameters) if law is None else named(shaped(law, shape, label), label, parameters, taken)


def _resistive(
    law: Any, potential: Any, variables: ca.SX, labels: tuple[str, str], parameters: Parameters
) -> tuple[ca.SX, ca.SX | None]:
    """A resistive law and its potential (DISPOT), the latter None where it would need an integration."""
    if law is not None and potential is not None:
        raise ModelError(f"{labels[0]} and {labels[1]} are both given: one determines the other")
    allowed = (variables, parameters.symbols)
    if potential is not None:
        given = shaped(potential, (1, 1), labels[1])
        _check_law(given, allowed, labels[1])
        return ca.gradient(given, variables), given
    if law is None:
        return ca.SX(variables.numel(), 1), ca.SX(0)
    resistive = shaped(law, (variables.numel(), 1), labels[0])
    _check_law(resistive, allowed, labels[0])
    jacobian = ca.jacobian(resistive, variables)
    if not _symmetric(jacobian, variables, parameters):
        raise ModelError(f"{labels[0]} is not the gradient of a potential: its Jacobian is not symmetric")
    linear = not depends(jacobian, variables)
    return resistive, ca.dot(variables, resistive) / 2 if linear else None


def _check_law(value: ca.SX, allowed: tuple[ca.SX, ca.SX], what: str) -> None:
    check_symbols(value, allowed, what, ca.SX(0, 1), "the state")
    check_finite(value, what)


def _sources(g_L: Any, g_C: Any, i_L: ca.SX, v_C: ca.SX, parameters: Parameters) -> ca.SX:
    """g_tilde = blkdiag(g_L, g_C): voltage sources act on inductors only, current sources on capacitors only."""
    blocks = []
    for value, variables, what in ((g_L, i_L, "g_L"), (g_C, v_C, "g_C")):
        rows = variables.numel()
        matrix = ca.SX(rows, 0) if value is None else expression(value, what)
        matrix = ca.sparsify(shaped(matrix, (rows, matrix.shape[1]), what))
        check_symbols(matrix, (parameters.symbols,), what, ca.vertcat(i_L, v_C), "the state")
        check_finite(matrix, what)
        blocks.append(matrix)
    g_tilde = ca.diagcat(*blocks)
    if g_tilde.shape[1] == 0:
        raise ModelError("the circuit has no source: give g_L or g_C")
    return g_tilde


def _brayton(
    i_L: ca.SX,
    v_C: ca.SX,
    *,
    storage: tuple[ca.SX, ca.SX],
    Gamma: ca.SX,
    resistive: tuple[ca.SX, ca.SX | None],
    conductive: tuple[ca.SX, ca.SX | None],
    g_tilde: ca.SX,
) -> Brayton:
    """Prop. pro:rcl, with Xi Q = blkdiag(-I, I) multiplied out by hand so that no inverse is left in Q_tilde."""
    (L, C), (v_R, P_R), (i_G, P_G) = storage, resistive, conductive
    x = ca.vertcat(i_L, v_C)
    gradient = ca.vertcat(ca.mtimes(Gamma, v_C) + v_R, ca.mtimes(Gamma.T, i_L) - i_G)
    hessian = ca.jacobian(gradient, x)
    signs = ca.diagcat(-ca.SX.eye(i_L.numel()), ca.SX.eye(v_C.numel()))
    P = None if P_R is None or P_G is None else ca.dot(i_L, ca.mtimes(Gamma, v_C)) + P_R - P_G
    return Brayton(
        Q=ca.diagcat(-L, C),
        P=P,
        P_gradient=gradient,
        P_hessian=hessian,
        Xi=ca.diagcat(inverse(L), inverse(C)),
        Q_tilde=ca.mtimes(hessian, signs),
        g_tilde=g_tilde,
        currents=i_L.numel(),
    )


def _affine(parts: Brayton, x: ca.SX, u: ca.SX, **keywords: Any) -> AffineSystem:
    k, c = parts.currents, x.numel() - parts.currents
    signs = ca.diagcat(-ca.SX.eye(k), ca.SX.eye(c))
    flow = ca.mtimes(parts.Xi, parts.P_gradient)
    return AffineSystem(
        x,
        u,
        ca.mtimes(signs, flow),
        ca.mtimes(ca.mtimes(signs, parts.Xi), parts.g_tilde),
        ca.dot(parts.P_gradient, flow) / 2,
        structure=Structure(A=parts.Q_tilde, circuit=parts),
        **keywords,
    )
