"""The storage of a loop in sectors, found on the checker's own reading of the loop."""

from __future__ import annotations

from typing import Any

from flint import fmpq_mpoly

from pbcgen.control.absolute import storage_of
from pbcgen.control.sectors import Polynomial, Sector, SectorLoop
from pbcgen.verify.stability import Stability


def in_sectors(system: Stability) -> dict[str, Any] | None:
    """P by its lower triangle and the weights, see :meth:`pbcgen.reading.sectors.Sectors.in_sectors`; or None."""
    read = system.sector_loop
    place = {k: i for i, k in enumerate(read.variables)}

    def written(a: fmpq_mpoly) -> Polynomial:
        terms = a.to_dict().items()
        return {tuple(sorted(place[k] for k, d in enumerate(e) for _ in range(int(d)))): c for e, c in terms}

    sectors = [Sector(written(z), least, 1 / soft if soft else None) for z, least, soft in read.sectors]
    outputs = [written(y) for y in read.outputs]
    found = storage_of(SectorLoop([written(v) for v in read.rates], sectors, outputs, read.leaks).straight())
    return None if found is None else found.written()
