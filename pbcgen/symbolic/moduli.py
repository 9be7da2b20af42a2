"""Functions with moduli |a|: which of them vanish on regions."""

from __future__ import annotations

from typing import TYPE_CHECKING

from flint import fmpq_mpoly

if TYPE_CHECKING:
    from pbcgen.symbolic.field import Field

#: Functions with as many moduli are taken to vanish on a region.
_MOST = 7


def vanishes_on_region(field: Field, polynomial: fmpq_mpoly) -> bool:
    """Whether a polynomial, as v + |v| does, may vanish on a region.

    It does where its product with itself for the other sign of a modulus does, which is free of that modulus; a modulus
    inside of another one comes before it.
    """
    norm, generators = polynomial, field.context.gens()
    for _ in range(_MOST):
        degrees = norm.degrees()
        inside = [k for k in field.moduli if degrees[k]]
        if not inside:
            return bool(norm.is_zero())
        last = max(inside)
        flipped = [-g if k == last else g for k, g in enumerate(generators)]
        norm = field.reduced(norm * norm.compose(*flipped, ctx=field.context))
    return True
