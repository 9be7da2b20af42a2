"""What a decomposition into squares ends in: polynomials that terms show to be positive, or trees of boxes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fractions import Fraction
from typing import Any

from flint import fmpq, fmpq_mpoly

from pbcgen.certify.writing import Writing
from pbcgen.passivity.plant import Plant
from pbcgen.passivity.region import Region
from pbcgen.proof.branch import Formula, formula_of, zero_set
from pbcgen.proof.harmonics import harmonic_squares
from pbcgen.proof.squares import Factor, Square
from pbcgen.proof.tree import tree
from pbcgen.symbolic.field import Field, Quotient
from pbcgen.symbolic.plain.formulas import Formulas
from pbcgen.symbolic.plain.outcomes import NotCheckable
from pbcgen.symbolic.plain.values import Field as PlainField
from pbcgen.symbolic.plain.values import Grow

#: Coordinates have a letter each.
_MOST_COORDINATES = 26
#: Boxes for each of the functions that a decomposition leaves.
_FEW = 400
#: Longer polynomials are not read again, nor those with more atoms.
_MOST_TERMS, _ATOMS = 30, 64


def by_sign(field: Field, polynomial: fmpq_mpoly, ends: Mapping[int, Any] | None = None) -> list[Square] | None:
    """The polynomial as one factor, if it has atoms and the checker finds by its terms that it is positive.

    With ``ends`` of symbols where it is between these; then it need not have atoms.
    """
    value = field.polynomial(polynomial)
    if len(polynomial) > _MOST_TERMS or (not ends and max(value.generators(), default=0) < field.symbol_count):
        return None
    writing, plain = Writing(), PlainField(field.symbol_count, _ATOMS)
    plain.ends |= ends or {}
    place = writing.quotient(value)
    try:
        found = Formulas.parse(writing.lines()).walk(plain.lift, {"state": plain.symbols})[place]
    except (Grow, NotCheckable, ZeroDivisionError):
        return None
    return [Square(fmpq(1), (Factor("positive", value, None),), (field.const(1),))] if plain.positive(found) else None


def by_sign_or_harmonics(
    field: Field, polynomial: fmpq_mpoly, ends: Mapping[int, Any] | None = None
) -> list[Square] | None:
    """The polynomial by its terms, or by its harmonics if it has nothing but sines and cosines."""
    signed = by_sign(field, polynomial, ends)
    return signed if signed is not None else harmonic_squares(field.polynomial(polynomial))


class Boxes:
    """Shows by a tree of boxes that a polynomial is nonnegative on the box that the system states (a ``Leaf``)."""

    def __init__(self, plant: Plant, region: Region) -> None:
        self.bounds, self.states, self.names = region.bounds, plant.system.n, plant.system.state_names

    def __call__(self, field: Field, polynomial: fmpq_mpoly) -> list[Square] | None:
        """The polynomial as one factor, or None."""
        if (signed := by_sign(field, polynomial)) is not None:
            return signed
        value = field.polynomial(polynomial)
        used = sorted(value.symbols())
        if not used or max(used) >= self.states:
            return None
        writing = Writing()
        place = writing.quotient(value)
        found = self.factor(writing, place, used, formula_of(field, polynomial, used), value, _FEW)
        return None if found is None else [Square(fmpq(1), (found,), (field.const(1),))]

    def factor(
        self, writing: Writing, place: int, used: list[int], formula: Formula, term: Quotient | int, boxes: int
    ) -> Factor | None:
        """The factor for a written term in the states that are used, which is the formula; None without a tree."""
        box = [(lo, hi) for k in used for lo, hi in [self.bounds[k]] if lo is not None and hi is not None]
        if len(box) < len(used) or len(used) > _MOST_COORDINATES:
            return None
        part = Formulas.parse(writing.lines())

        def function(x: Sequence[Any]) -> Any:
            return part.walk(lambda v: v, {"state": dict(zip(used, x, strict=True))}, None, [place])[place]

        names = [self.names[k] for k in used]
        zeros = zero_set(formula, names, [Fraction(0)] * len(used)) or {}
        found = tree(function, box, zeros, boxes)
        if found is None:
            return None
        return Factor("box", term, None, (found, used, {str(k): str(v) for k, v in zeros.items()}))
