"""What the kinds of the atoms of a field tell about their signs: exp > 0, xi tanh(a xi) >= 0, sin in [-1, 1]."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

from flint import fmpq_mpoly

from pbcgen.proof.spot import Spots
from pbcgen.symbolic.field import Field

POSITIVE_KINDS = frozenset({"exp"})
_NONNEGATIVE_KINDS = frozenset({"sqrt", "fabs"})
#: Odd increasing functions: T(xi) has the sign of xi.
SECTOR_KINDS = frozenset({"tanh", "atan", "asinh", "erf", "asin", "atanh"})
#: Increasing functions whose sums of arguments the field does not take apart.
_INCREASING_KINDS = SECTOR_KINDS | {"log", "sqrt"}
#: Functions with values in [-1, 1] whatever their argument.
BOUNDED_KINDS = frozenset({"sin", "cos", "tanh", "erf"})
#: Functions that are analytic on the whole line.
ENTIRE_KINDS = frozenset({"sin", "cos", "exp", "tanh", "atan", "asinh", "erf"})

Exponents = tuple[int, ...]


@dataclass(frozen=True)
class Known:
    """What is known of the sign of the generators of a field.

    Attributes:
        positive: generators that are nowhere negative.
        sector: for an odd increasing atom of a monomial the exponents of that monomial.
        pairs: polynomials T, xi with T xi >= 0.
        bounded: atoms with values in [-1, 1].
        exponentials: atoms exp(a) with a polynomial a.
        spots: values at sample points, which show that there is nothing to prove.
    """

    positive: frozenset[int]
    sector: dict[int, Exponents]
    pairs: tuple[tuple[fmpq_mpoly, fmpq_mpoly], ...]
    bounded: frozenset[int]
    exponentials: frozenset[int]
    spots: Spots

    @staticmethod
    def of(field: Field, positive_symbols: frozenset[int] = frozenset()) -> Known:
        """What the kinds of the atoms tell; symbols in ``positive_symbols`` are taken to be positive."""
        positive = set(positive_symbols)
        positive |= {k for k, a in field.atoms.items() if a.kind in POSITIVE_KINDS | _NONNEGATIVE_KINDS}
        sector: dict[int, Exponents] = {}
        for k, atom in field.atoms.items():
            terms = atom.argument.numerator.to_dict()
            if atom.kind in SECTOR_KINDS and len(terms) == 1 and atom.argument.is_polynomial():
                ((exponents, coefficient),) = terms.items()
                if coefficient > 0:
                    sector[k] = tuple(0 if i in positive else int(e) for i, e in enumerate(exponents))
        pairs = tuple(_pairs(field, frozenset(positive)))
        bounded = frozenset(k for k, a in field.atoms.items() if a.kind in BOUNDED_KINDS)
        exponentials = frozenset(k for k, a in field.atoms.items() if a.kind == "exp" and a.argument.is_polynomial())
        return Known(frozenset(positive), sector, pairs, bounded, exponentials, Spots(field, positive_symbols))


def _pairs(field: Field, positive: frozenset[int]) -> Iterator[tuple[fmpq_mpoly, fmpq_mpoly]]:
    """Polynomials with a product that is nowhere negative, from increasing atoms."""
    atoms = [
        (k, a) for k, a in sorted(field.atoms.items()) if a.kind in _INCREASING_KINDS and a.argument.is_polynomial()
    ]
    generators = field.context.gens()
    for k in sorted(field.moduli):
        argument = field.atoms[k].argument.numerator
        yield generators[k] + argument, field.context.constant(1)
        yield generators[k] - argument, field.context.constant(1)
    for k, atom in atoms:
        if atom.kind != "sqrt":
            zero = 1 if atom.kind == "log" else 0
            yield generators[k], without_content(field, atom.argument.numerator - zero, positive)
    for (k, a), (j, b) in combinations(atoms[:12], 2):
        if a.kind == b.kind:
            difference = a.argument.numerator - b.argument.numerator
            yield generators[k] - generators[j], without_content(field, difference, positive)


def without_content(field: Field, polynomial: fmpq_mpoly, positive: frozenset[int]) -> fmpq_mpoly:
    """The polynomial without the powers of positive generators that divide it."""
    terms = polynomial.to_dict()
    if not terms:
        return polynomial
    least = [min(int(e[k]) for e in terms) if k in positive else 0 for k in range(len(next(iter(terms))))]
    return field.context.from_dict(
        {tuple(int(a) - b for a, b in zip(e, least, strict=True)): c for e, c in terms.items()}
    )
