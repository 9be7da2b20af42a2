"""Mechanical systems in port-Hamiltonian form (phmec)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import casadi as ca

from pbcgen.errors import ModelError
from pbcgen.models.affine import AffineSystem, IntervalLike, MeasuredLike, Mechanics, Structure
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
from pbcgen.models.factors import Factors, given_factors, squares, sum_of_factors
from pbcgen.models.inertia import inverse, named_constants, solve
from pbcgen.models.numbers import named, named_numbers
from pbcgen.models.parameters import Parameters

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence


@dataclass(frozen=True, eq=False, init=False)
class Mechanical:
    """A mechanical system ``q' = grad_p H, p' = -grad_q H - D grad_p H + G u`` with ``H = p^T M^-1 p / 2 + V``.

    Attributes:
        q: positions and momenta, n x 1 symbols.
        p: likewise.
        u: input, m x 1 symbols.
        parts: M, M^-1, V, D, G, the velocity and the gradient of H.
        system: the input-affine system with state (q, p) and storage H.
    """

    q: ca.SX
    p: ca.SX
    u: ca.SX
    parts: Mechanics
    system: AffineSystem

    def __init__(
        self,
        q: Any,
        p: Any,
        *,
        V: Any,
        G: Any,
        M: Any = None,
        M_inv: Any = None,
        D: Any = None,
        parameters: Parameters | None = None,
        inputs: Sequence[str] | None = None,
        domain: Mapping[str, IntervalLike] | None = None,
        gamma: Any = None,
        eta: Any = None,
        measured: MeasuredLike | None = None,
        units: Mapping[str, str] | None = None,
        name: str = "",
    ) -> None:
        """Check and store the system.

        Args:
            q: positions, n SX symbols.
            p: momenta, n SX symbols.
            V: potential energy, scalar function of q.
            G: input matrix, n x m function of q, of full column rank.
            M: inertia matrix, n x n function of q; a list of n entries is its diagonal; a list of pairs (J_i, W_i) is
                ``sum J_i^T W_i J_i``, with J_i of n columns and W_i > 0 (a list is its diagonal, a number a multiple
                of I).
            M_inv: its inverse. One of the two is enough.
            D: damping, n x n symmetric function of (q, p), or the list of its diagonal; none if not given.
            parameters: the constants that occur.
            inputs: names of the inputs; ``u_1, u_2, ...`` if not given.
            domain: (lo, hi) by state name.
            gamma: known gamma(x), m entries.
            eta: known eta(x).
            measured: state names and/or named expressions; the positions if not given.
            units: units by name.
            name: how reports call the system.

        Raises:
            ModelError: for wrong shapes or symbols, M or D not symmetric, M singular.
        """
        q, p = symbols(q, "the positions q"), symbols(p, "the momenta p")
        parameters = parameters if parameters is not None else Parameters()
        if q.numel() != p.numel():
            raise ModelError(f"there are {q.numel()} positions q and {p.numel()} momenta p: give one momentum for each")
        taken = [*names(q), *names(p), *([inputs] if isinstance(inputs, str) else inputs or [])]
        factors = given_factors(M, q.numel())
        if factors:
            parts, parameters = named_numbers([part for pair in factors for part in pair], "M", parameters, taken)
            factors = tuple(zip(parts[::2], parts[1::2], strict=True))
            M = sum_of_factors(factors)
        if M is not None and M_inv is None:
            given = ca.sparsify(square(M, q.numel(), "the inertia matrix M"))
            M, parameters = named_constants(given, "M", parameters)
            M, parameters = named(M, "M", parameters, taken)
        V, parameters = named(shaped(V, (1, 1), "the potential energy V"), "V", parameters, taken)
        if D is not None:
            D, parameters = named(square(D, q.numel(), "the damping D"), "D", parameters, taken)
        G, parameters = named(expression(G, "the input matrix G"), "G", parameters, taken)
        mechanics = _mechanics(q, p, M=M, M_inv=M_inv, V=V, D=D, G=G, parameters=parameters, factors=factors)
        u = input_symbols(inputs, mechanics.G.shape[1])
        system = _affine(
            mechanics,
            u,
            parameters=parameters,
            domain=domain,
            gamma=gamma,
            eta=eta,
            measured=measured if measured is not None else names(q),
            units=units,
            name=name,
        )
        for key, value in {"q": q, "p": p, "u": u, "parts": mechanics, "system": system}.items():
            object.__setattr__(self, key, value)

    @classmethod
    def from_lagrangian(
        cls,
        q: Any,
        qdot: Any,
        *,
        T: Any,
        V: Any,
        G: Any,
        D: Any = None,
        momenta: Sequence[str] | None = None,
        parameters: Parameters | None = None,
        **keywords: Any,
    ) -> Mechanical:
        """The system with Lagrangian ``L = T(q, q') - V(q)`` and generalised forces ``G u - D q'``.

        Args:
            q: positions, n SX symbols.
            qdot: velocities, n SX symbols.
            T: kinetic energy, a quadratic form in the velocities: ``T = q'^T M(q) q' / 2``.
            V: potential energy, scalar function of q.
            G: input matrix, n x m function of q.
            D: damping, n x n symmetric function of (q, q'), or the list of its diagonal.
            momenta: names of the momenta; ``p_`` and the name of the position if not given.
            parameters: the constants that occur.
            **keywords: as for the constructor.

        Raises:
            ModelError: also if T is not a quadratic form in the velocities.
        """
        q, qdot = symbols(q, "the positions q"), symbols(qdot, "the velocities qdot")
        if q.numel() != qdot.numel():
            raise ModelError(f"there are {q.numel()} positions q and {qdot.numel()} velocities qdot: give equally many")
        energy = shaped(T, (1, 1), "the kinetic energy T")
        factors = squares(energy, qdot)
        M = sum_of_factors(factors) if factors else _inertia_of(energy, qdot)
        chosen = tuple(momenta) if momenta is not None else tuple(f"p_{name}" for name in names(q))
        if len(chosen) != q.numel():
            raise ModelError(f"there are {len(chosen)} names of momenta: one for each of {q.numel()} positions, please")
        p = ca.vertcat(*[ca.SX.sym(name) for name in chosen])
        damping = None
        if D is not None:
            damping = ca.substitute(square(D, q.numel(), "the damping D"), qdot, solve(M, p))
        inertia = list(factors) if factors else M
        return cls(q, p, V=V, G=G, M=inertia, D=damping, parameters=parameters, **keywords)

    def lower(self) -> AffineSystem:
        """The system as ``x' = f + g u`` with x = (q, p), S = H, and ``f = F grad H``."""
        return self.system


def input_symbols(inputs: Sequence[str] | None, m: int) -> ca.SX:
    """A column of m input symbols with the given names, or ``u_1, u_2, ...``.

    Raises:
        ModelError: if the number of names is not m.
    """
    chosen = [f"u_{i + 1}" for i in range(m)] if inputs is None else [inputs] if isinstance(inputs, str) else [*inputs]
    if len(chosen) != m:
        raise ModelError(f"`inputs` has {len(chosen)} names, the input matrix has {m} columns")
    return ca.vertcat(*[ca.SX.sym(name) for name in chosen])


def _mechanics(
    q: ca.SX,
    p: ca.SX,
    *,
    M: Any,
    M_inv: Any,
    V: Any,
    D: Any,
    G: Any,
    parameters: Parameters,
    factors: Factors,
) -> Mechanics:
    """The parts, checked."""
    n = q.numel()
    potential = shaped(V, (1, 1), "the potential energy V")
    damping = ca.sparsify(square(D, n, "the damping D")) if D is not None else ca.SX(n, n)
    actuation = expression(G, "the input matrix G")
    actuation = shaped(actuation, (n, actuation.shape[1]), "the input matrix G")
    inertia, inverse_inertia = _inertia_pair(M, M_inv, n)
    constants = parameters.symbols
    for value, what, allowed, forbidden in (
        (inertia, "the inertia matrix M", (q, constants), p),
        (inverse_inertia, "the inverse inertia matrix M_inv", (q, constants), p),
        (potential, "the potential energy V", (q, constants), p),
        (actuation, "the input matrix G", (q, constants), p),
        (damping, "the damping D", (q, p, constants), ca.SX(0, 1)),
    ):
        check_symbols(value, allowed, what, forbidden, "the momentum")
        check_finite(value, what)
    if not vanishes_at_samples(
        damping - damping.T, ca.norm_fro(damping), ca.vertcat(q, p), constants, parameters.numeric
    ):
        raise ModelError("the damping D is not symmetric: gyroscopic forces belong into an AffineSystem")
    _check_inertia(inertia, inverse_inertia, q, parameters)
    velocity, gradient = energy_slope(q, p, potential, inertia if M is not None else None, inverse_inertia)
    return Mechanics(
        q,
        p,
        inertia,
        inverse_inertia,
        potential,
        damping,
        actuation,
        velocity,
        gradient,
        factors if M is not None else (),
    )


def energy_slope(q: ca.SX, p: ca.SX, V: ca.SX, M: ca.SX | None, M_inv: ca.SX) -> tuple[ca.SX, ca.SX]:
    """The velocity ``v = M^-1 p`` and the gradient of ``H = p^T v / 2 + V`` in (q, p), for symmetric M.

    With M no inverse is differentiated: ``grad_q H = grad V - v^T (dM/dq) v / 2``. Without it M_inv is used.
    """
    if M is not None:
        velocity = solve(M, p)
        kinetic = -_form_gradient(M, velocity, q)
    else:
        velocity = ca.mtimes(M_inv, p)
        kinetic = _form_gradient(M_inv, p, q)
    return velocity, ca.vertcat(ca.gradient(V, q) + kinetic, velocity)


def _inertia_pair(M: Any, M_inv: Any, n: int) -> tuple[ca.SX, ca.SX]:
    if M is None and M_inv is None:
        raise ModelError("the inertia is missing: give M or M_inv")
    given = None if M is None else ca.sparsify(square(M, n, "the inertia matrix M"))
    given_inverse = None if M_inv is None else ca.sparsify(square(M_inv, n, "the inverse inertia matrix M_inv"))
    for value, what in ((given, "the inertia matrix M"), (given_inverse, "the inverse inertia matrix M_inv")):
        if value is not None and ca.sprank(value) < n:
            raise ModelError(f"{what} is singular: its nonzero entries leave a row without partner")
    if given is None:
        assert given_inverse is not None
        return inverse(given_inverse), given_inverse
    return given, given_inverse if given_inverse is not None else inverse(given)


def _form_gradient(matrix: ca.SX, vector: ca.SX, q: ca.SX) -> ca.SX:
    """The gradient in q of ``vector^T matrix(q) vector / 2`` with the vector held constant."""
    frozen = ca.SX.sym("v", vector.numel())
    return ca.substitute(ca.gradient(ca.dot(frozen, ca.mtimes(matrix, frozen)) / 2, q), frozen, vector)


def _check_inertia(M: ca.SX, M_inv: ca.SX, q: ca.SX, parameters: Parameters) -> None:
    """Symmetry, M M^-1 = I and M > 0 somewhere, at sample points: a guard against slips, proofs are made elsewhere."""
    where = (q, parameters.symbols, parameters.numeric)
    for value, what in ((M, "the inertia matrix M"), (M_inv, "the inverse inertia matrix M_inv")):
        if not vanishes_at_samples(value - value.T, ca.norm_fro(value), *where):
            raise ModelError(f"{what} is not symmetric")
    scale = ca.norm_fro(M) * ca.norm_fro(M_inv)
    if not vanishes_at_samples(ca.mtimes(M, M_inv) - ca.SX.eye(M.shape[0]), scale, *where):
        raise ModelError("M and M_inv are not inverse to each other")
    if never_positive_definite(M, *where):
        raise ModelError(
            "the inertia matrix M is not positive definite: look for a negative mass or inertia, or a coupling that is "
            "larger than the inertias it couples"
        )


def _inertia_of(T: ca.SX, qdot: ca.SX) -> ca.SX:
    """The Hessian of T in qdot.

    Raises:
        ModelError: unless T is a quadratic form: Hessian free of qdot, no linear and no constant part.
    """
    M, gradient = ca.hessian(T, qdot)
    if depends(M, qdot):
        raise ModelError("the kinetic energy T is not quadratic in the velocities: its Hessian depends on them")
    rest = ca.SX.zeros(qdot.numel())
    if not ca.substitute(gradient, qdot, rest).is_zero():
        raise ModelError("the kinetic energy T has a part that is linear in the velocities: this is not supported")
    if not ca.substitute(T, qdot, rest).is_zero():
        raise ModelError("the kinetic energy T does not vanish at rest: move the part without velocities to V")
    return ca.sparsify(ca.tril2symm(ca.tril(M)))


def _affine(parts: Mechanics, u: ca.SX, **keywords: Any) -> AffineSystem:
    n, m = parts.q.numel(), u.numel()
    identity = ca.SX.eye(n)
    F = ca.blockcat([[ca.SX(n, n), identity], [-identity, -parts.D]])
    return AffineSystem(
        ca.vertcat(parts.q, parts.p),
        u,
        ca.mtimes(F, parts.energy_gradient),
        ca.vertcat(ca.SX(n, m), parts.G),
        ca.dot(parts.p, parts.velocity) / 2 + parts.V,
        structure=Structure(F=F, mechanical=parts),
        **keywords,
    )
