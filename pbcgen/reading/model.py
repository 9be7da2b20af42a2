"""The model that a certificate speaks of, read from the text that its hash is the hash of."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from flint import fmpq

from pbcgen.symbolic.plain.formulas import Formulas, rational
from pbcgen.symbolic.plain.outcomes import Malformed, require


@dataclass(frozen=True)
class Model:
    """System, target, law and limits, read from the canonical text that the model's hash is the hash of."""

    formulas: Formulas
    words: dict[str, list[str]]
    parameters: list[fmpq]
    domain: dict[str, list[fmpq | None]]
    target: dict[str, fmpq]
    gains: dict[str, list[list[fmpq]]]
    limits: list[tuple[list[fmpq], fmpq]]
    #: What may be set at run time: a condition of the target, or an entry of a gain; the least and the largest value.
    settings: list[tuple[str, int | None, fmpq, fmpq]]

    @staticmethod
    def parse(text: str) -> Model:
        """Read the text. Raises Malformed for gains that no law has."""

        def found(pattern: str) -> list[Any]:
            return re.findall(f"^{pattern}$", text, re.M)

        lines = text.splitlines()
        words = {key: rest.split() for key, _, rest in (line.partition(" ") for line in lines) if key}
        domain = {name: [_bound(lo), _bound(hi)] for name, lo, hi in found(r"domain (\S+) (\S+) (\S+)")}
        target = {name: rational(value) for name, value in found(r"target (.+) = (\S+)")}
        gains = {name: _gain(value, len(words["inputs"])) for name, value in found(r"gain (\S+) = (.+)")}
        limits = [(_numbers(row), rational(bound)) for row, bound in found(r"limit \[(.+)\] u <= (\S+)")]
        for name, *bounds in found(r"limit ([^\s\[]+) (\S+) (\S+)"):
            unit = [fmpq(int(name == other)) for other in words["inputs"]]
            for side, bound in zip((-1, 1), map(_bound, bounds), strict=True):
                if bound is not None:
                    limits.append(([side * v for v in unit], side * bound))
        settings: list[Any] = [(name, None, *ends) for name, *ends in found(r"adjustable target (.+) (\S+) (\S+)")]
        rows = found(r"adjustable gain (\S+) (\d+) (\S+) (\S+)")
        settings += [(name, int(entry) - 1, *ends) for name, entry, *ends in rows]
        settings = [(name, entry, rational(lo), rational(hi)) for name, entry, lo, hi in settings]
        numbers = [rational(value) for _, value in found(r"parameter (.+) = (.+)")]
        return Model(Formulas.parse(lines), words, numbers, domain, target, gains, limits, settings)

    def is_constant(self, name: str) -> bool:
        """Whether no state enters a matrix."""
        needed = self.formulas.needed(self.formulas.outputs[name][2].values())
        return not any(self.formulas.instructions[k][0] == "state" for k in needed)

    def with_settings(self, values: Sequence[Any]) -> Model:
        """The model with other values of what may be set."""
        target, gains = {**self.target}, {name: [[*row] for row in rows] for name, rows in self.gains.items()}
        for (name, entry, _, _), value in zip(self.settings, values, strict=True):
            if entry is None:
                target[name] = value
            else:
                gains[name][entry if len(gains[name]) > 1 else 0][entry] = value
        return replace(self, target=target, gains=gains)

    def vector(self, name: str) -> list[fmpq]:
        """A gain with one positive entry for each input; ``name`` or ``name_c``."""
        return self.gains.get(name, self.gains.get(f"{name}_c", [[]]))[0]


def _bound(text: str) -> fmpq | None:
    return None if text == "unbounded" else rational(text)


def _numbers(text: str) -> list[fmpq]:
    return [rational(word) for word in text.split()]


def _gain(text: str, m: int) -> list[list[fmpq]]:
    """A vector as one row, a matrix as its rows; one number stands for every channel."""
    rows = [_numbers(row) for row in re.findall(r"[^\[\]]+", text) if row.strip()]
    if not text.startswith("[["):
        require(min(rows[0]) > 0, "a gain is not positive", Malformed)
        return [rows[0] * m] if len(rows[0]) == 1 else rows
    single = len(rows) == len(rows[0]) == 1
    return [[rows[0][0] * (i == j) for j in range(m)] for i in range(m)] if single else rows
