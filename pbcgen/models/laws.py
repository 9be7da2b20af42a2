"""The control laws with their gains, as data.

Gains are exact. A single number is broadcast to every channel when :meth:`resolve` learns the number of inputs; a
matrix gain may be given as k (for k I), as the list of its diagonal, or as the list of its rows.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from fractions import Fraction
from typing import Any, ClassVar, Self, overload

from pbcgen.errors import ModelError
from pbcgen.models.exact import exact
from pbcgen.models.gains import (
    Matrix,
    MatrixLike,
    Vector,
    VectorLike,
    diagonal_matrix,
    is_sequence,
    rank,
    rectangle,
    sized_matrix,
    sized_vector,
    symmetric,
    vector,
)


@dataclass(frozen=True, init=False)
class PassiveOutput:
    """Law (u): ``u = -kappa - alpha tanh(beta (gamma - gamma_*)) - k_p tanh(y)``. Needs the full state.

    Attributes:
        alpha: the largest pull, positive, one for each input, in units of u.
        beta: how steeply it gets there, positive, one for each input; alpha beta is a stiffness.
        k_p: the largest pull against y, positive, one for each input.
    """

    name: ClassVar[str] = "passive-output"
    alpha: Vector
    beta: Vector
    k_p: Vector

    def __init__(self, alpha: VectorLike, beta: VectorLike, k_p: VectorLike) -> None:
        """Store exact gains. Raises ModelError if one is not a positive number."""
        _store(self, alpha=vector(alpha, "alpha"), beta=vector(beta, "beta"), k_p=vector(k_p, "k_p"))

    def resolve(self, m: int, s: int | None = None) -> PassiveOutput:
        """The law with m entries in each gain. Raises ModelError for a wrong length."""
        return PassiveOutput(
            sized_vector(self.alpha, m, "alpha"), sized_vector(self.beta, m, "beta"), sized_vector(self.k_p, m, "k_p")
        )


@dataclass(frozen=True, init=False)
class _OneFilter:
    """The gains of a law with the filter x_c and nothing else."""

    alpha: Vector
    beta: Vector
    K_c: Matrix
    R_c: Matrix

    def __init__(self, alpha: VectorLike, beta: VectorLike, K_c: MatrixLike, R_c: MatrixLike) -> None:
        """Store exact gains. Raises ModelError for nonpositive or nonsymmetric ones."""
        _store(
            self,
            alpha=vector(alpha, "alpha"),
            beta=vector(beta, "beta"),
            K_c=symmetric(K_c, "K_c"),
            R_c=symmetric(R_c, "R_c"),
        )

    def resolve(self, m: int, s: int | None = None) -> Self:
        """The law with full shapes. Raises ModelError for a wrong size."""
        return type(self)(
            sized_vector(self.alpha, m, "alpha"),
            sized_vector(self.beta, m, "beta"),
            sized_matrix(self.K_c, m, "K_c"),
            sized_matrix(self.R_c, m, "R_c"),
        )


@dataclass(frozen=True, init=False)
class DynamicExtension(_OneFilter):
    """Law (uc), (dxc): ``u = -kappa - alpha tanh(beta z_c)`` with the filter x_c. Needs gamma measured.

    Attributes:
        alpha: the largest pull, positive, one for each input, in units of u.
        beta: how steeply it gets there, positive, one for each input; alpha beta is a stiffness.
        K_c: stiffness of the filter, symmetric m x m; that it is positive definite is a claim to be proved.
        R_c: how fast the filter follows, likewise.
    """

    name: ClassVar[str] = "dynamic-extension"

    def __init__(self, alpha: VectorLike, beta: VectorLike, K_c: MatrixLike, R_c: MatrixLike) -> None:
        """Store exact gains. Raises ModelError for nonpositive or nonsymmetric ones."""
        super().__init__(alpha, beta, K_c, R_c)


@dataclass(frozen=True, init=False)
class NaturalDamping:
    """Law (ulc), (dxc), (dxl): (uc) and ``-alpha_l tanh(beta_l z_l)``. Needs gamma and eta measured.

    Attributes:
        alpha_c: the largest pull, positive, one for each input, in units of u.
        beta_c: how steeply it gets there, positive, one for each input; alpha_c beta_c is a stiffness.
        alpha_l: the largest pull of the term in x_l, positive, one for each input.
        beta_l: how steeply it gets there, positive, one for each input; alpha_l beta_l is a stiffness.
        K_c: stiffness of the filter x_c, symmetric m x m.
        R_c: how fast x_c follows, likewise.
        K_l: stiffness of the filter x_l, diagonal positive m x m.
        R_l: how fast x_l follows, likewise.
        Upsilon: m x s of rank min(m, s), or None for the identity pattern of this shape.
    """

    name: ClassVar[str] = "natural-damping"
    alpha_c: Vector
    beta_c: Vector
    K_c: Matrix
    R_c: Matrix
    alpha_l: Vector
    beta_l: Vector
    K_l: Matrix
    R_l: Matrix
    Upsilon: Matrix | None

    def __init__(
        self,
        alpha_c: VectorLike,
        beta_c: VectorLike,
        K_c: MatrixLike,
        R_c: MatrixLike,
        *,
        alpha_l: VectorLike,
        beta_l: VectorLike,
        K_l: MatrixLike,
        R_l: MatrixLike,
        Upsilon: MatrixLike | None = None,
    ) -> None:
        """Store exact gains.

        Raises:
            ModelError: for nonpositive gains, K_c or R_c not symmetric, K_l or R_l not diagonal. Prop. pro4 does not
                allow alpha_l = 0: without the term in x_l the law is DynamicExtension.
        """
        _store(
            self,
            alpha_c=vector(alpha_c, "alpha_c"),
            beta_c=vector(beta_c, "beta_c"),
            K_c=symmetric(K_c, "K_c"),
            R_c=symmetric(R_c, "R_c"),
            alpha_l=_alpha_l(alpha_l),
            beta_l=vector(beta_l, "beta_l"),
            K_l=diagonal_matrix(K_l, "K_l"),
            R_l=diagonal_matrix(R_l, "R_l"),
            Upsilon=None if Upsilon is None else _upsilon(Upsilon),
        )

    def resolve(self, m: int, s: int | None = None) -> NaturalDamping:
        """The law with full shapes; Upsilon is left as it is while s, the length of eta, is not known.

        Raises:
            ModelError: for a wrong size, or if Upsilon has not rank min(m, s).
        """
        return NaturalDamping(
            sized_vector(self.alpha_c, m, "alpha_c"),
            sized_vector(self.beta_c, m, "beta_c"),
            sized_matrix(self.K_c, m, "K_c"),
            sized_matrix(self.R_c, m, "R_c"),
            alpha_l=sized_vector(self.alpha_l, m, "alpha_l"),
            beta_l=sized_vector(self.beta_l, m, "beta_l"),
            K_l=sized_matrix(self.K_l, m, "K_l"),
            R_l=sized_matrix(self.R_l, m, "R_l"),
            Upsilon=self.Upsilon if s is None else _sized_upsilon(self.Upsilon, m, s),
        )


@dataclass(frozen=True, init=False)
class PotentialCompensation(_OneFilter):
    """Law (umec): ``u = grad V(q) - alpha tanh(beta z_c)``, for fully actuated mechanical systems with G = I.

    Attributes:
        alpha: the largest pull, positive, one for each input, in units of u.
        beta: how steeply it gets there, positive, one for each input; alpha beta is a stiffness.
        K_c: stiffness of the filter, symmetric m x m; that it is positive definite is a claim to be proved.
        R_c: how fast the filter follows, likewise.
    """

    name: ClassVar[str] = "potential-compensation"

    def __init__(self, alpha: VectorLike, beta: VectorLike, K_c: MatrixLike, R_c: MatrixLike) -> None:
        """Store exact gains. Raises ModelError for nonpositive or nonsymmetric ones."""
        super().__init__(alpha, beta, K_c, R_c)


@dataclass(frozen=True, init=False)
class Integral:
    """Law (conint), (dpsi): the law ``base`` and a filter psi of the position error, ``-alpha_psi tanh(beta_psi psi)``.

    ``psi' = -R_psi psi + alpha_psi beta_psi sech(beta_psi psi) (gamma - gamma_*)``, with gamma = q for a robot arm.
    Near rest this is an integral term of (alpha_psi beta_psi)^2 per unit of error and second; it slows down
    as alpha_psi is used up.

    Attributes:
        base: the law that the filter is added to.
        alpha_psi: the largest pull, positive, one for each input, in units of u.
        beta_psi: how steeply it gets there, positive, one for each input; alpha_psi beta_psi is a stiffness.
        R_psi: diagonal m x m leak of the filter; 0 is a pure integrator.
    """

    name: ClassVar[str] = "integral"
    base: DynamicExtension | NaturalDamping | PotentialCompensation
    alpha_psi: Vector
    beta_psi: Vector
    R_psi: Matrix

    def __init__(
        self,
        base: DynamicExtension | NaturalDamping | PotentialCompensation,
        alpha_psi: VectorLike,
        beta_psi: VectorLike,
        R_psi: MatrixLike,
    ) -> None:
        """Store exact gains. Raises ModelError for nonpositive gains, and for a base that no filter can be added to."""
        if not isinstance(base, DynamicExtension | NaturalDamping | PotentialCompensation):
            raise ModelError(
                f"the base of Integral is {_called(base)}: it must be DynamicExtension, NaturalDamping or "
                "PotentialCompensation"
            )
        _store(
            self,
            base=base,
            alpha_psi=vector(alpha_psi, "alpha_psi"),
            beta_psi=vector(beta_psi, "beta_psi"),
            R_psi=diagonal_matrix(R_psi, "R_psi", allow_zero=True),
        )

    def resolve(self, m: int, s: int | None = None) -> Integral:
        """The law with full shapes, its base too. Raises ModelError for a wrong size."""
        return Integral(
            self.base.resolve(m, s),
            sized_vector(self.alpha_psi, m, "alpha_psi"),
            sized_vector(self.beta_psi, m, "beta_psi"),
            sized_matrix(self.R_psi, m, "R_psi"),
        )


BaseLaw = PassiveOutput | DynamicExtension | NaturalDamping | PotentialCompensation
Law = BaseLaw | Integral


@overload
def base_law(law: Law) -> BaseLaw: ...


@overload
def base_law(law: Law | None) -> BaseLaw | None: ...


def base_law(law: Law | None) -> BaseLaw | None:
    """The law without its integral term; None where there is none."""
    return law.base if isinstance(law, Integral) else law


@dataclass(frozen=True)
class Shaping:
    """The saturated term in gamma of a law, whatever the law calls its gains, and the filter inside it.

    Attributes:
        alpha: the largest pull, one for each input.
        beta: how steeply it gets there, likewise.
        K_c, R_c: of the filter x_c; None for PassiveOutput, which has none.
    """

    alpha: Vector
    beta: Vector
    K_c: Matrix | None = None
    R_c: Matrix | None = None

    @property
    def stiffness(self) -> Vector:
        """alpha beta, one for each input."""
        return tuple(a * b for a, b in zip(self.alpha, self.beta, strict=True))


def shaping(law: Law) -> Shaping:
    """The term in gamma of a law, or of the base of Integral."""
    base = base_law(law)
    if isinstance(base, NaturalDamping):
        return Shaping(base.alpha_c, base.beta_c, base.K_c, base.R_c)
    if isinstance(base, PassiveOutput):
        return Shaping(base.alpha, base.beta)
    return Shaping(base.alpha, base.beta, base.K_c, base.R_c)


def filters(law: Law) -> int:
    """How many states the controller has for each input."""
    base = base_law(law)
    own = 0 if isinstance(base, PassiveOutput) else 2 if isinstance(base, NaturalDamping) else 1
    return own + isinstance(law, Integral)


def is_amplitude(gain: str) -> bool:
    """Whether a gain bounds a term of the input."""
    return gain.startswith("alpha") or gain == "k_p"


def amplitudes(law: Law) -> Vector:
    """The largest pull of all saturated terms together, one for each input."""
    terms = [value for name, value in gains(law).items() if is_amplitude(name)]
    return tuple(sum(column, Fraction(0)) for column in zip(*terms, strict=True))


def gains(law: Law) -> dict[str, Vector | Matrix]:
    """The gains by name, in the order of the law's arguments; those of the base of Integral come first."""
    found: dict[str, Vector | Matrix] = {}
    for item in fields(law):
        value = getattr(law, item.name)
        if item.name == "base":
            found |= gains(value)
        elif value is not None:
            found[item.name] = value
    return found


def _store(law: object, **values: object) -> None:
    for name, value in values.items():
        object.__setattr__(law, name, value)


def _called(value: object) -> str:
    return getattr(value, "name", None) or repr(value)


def _alpha_l(value: Any) -> Vector:
    entries = value if is_sequence(value) else [value]
    if any(exact(entry, "the gain alpha_l") == 0 for entry in entries):
        raise ModelError(
            "the gain alpha_l is 0: natural-damping needs it positive; without this term use DynamicExtension, "
            "which has no x_l"
        )
    return vector(value, "alpha_l")


def _upsilon(value: Any) -> Matrix:
    return rectangle(list(value), "Upsilon") if is_sequence(value) else ((exact(value, "the gain Upsilon"),),)


def _sized_upsilon(value: Matrix | None, m: int, s: int) -> Matrix:
    """Upsilon of (Phil), m x s; by default ones on the diagonal."""
    if value is None:
        return tuple(tuple(Fraction(i == j) for j in range(s)) for i in range(m))
    if (len(value), len(value[0])) != (m, s):
        raise ModelError(
            f"the gain Upsilon is {len(value)}x{len(value[0])}: {m}x{s} was expected (inputs x length of eta)"
        )
    if rank(value) < min(m, s):
        raise ModelError(f"the gain Upsilon has rank {rank(value)}: rank {min(m, s)} is needed")
    return value
