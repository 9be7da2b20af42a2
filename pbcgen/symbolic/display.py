"""Formulas of exact functions as text, grouped by state and atom, with factored coefficients."""

from __future__ import annotations

import re
from collections.abc import Iterable
from fractions import Fraction

from flint import fmpq, fmpq_mpoly

from pbcgen.symbolic.coefficients import Coefficients
from pbcgen.symbolic.field import Quotient
from pbcgen.symbolic.real import fraction, rational
from pbcgen.symbolic.terms import Powers, descending, terms

#: A ratio of numbers below this is shown as one, else as a decimal.
_SHORT = 1000


def number(value: Fraction, digits: int = 12) -> str:
    """A rational for a reader: a short decimal when it is one, else a fraction, else a rounded decimal."""
    shown = f"{float(value):.{digits}g}"
    if Fraction(shown) == value:
        return shown
    return f"{value.numerator}/{value.denominator}" if value.denominator < 10**4 else shown


def formula(function: Quotient, parameters: Iterable[int] = ()) -> str:
    """The function as text in the names of its field; symbols in ``parameters`` form the coefficients."""
    return _Printer(Coefficients(function.field, parameters)).function(function)


class _Printer:
    """Prints the functions of one field."""

    def __init__(self, coefficients: Coefficients) -> None:
        self.field, self.coefficients = coefficients.field, coefficients
        self._atoms: dict[int, str] = {}

    def generator(self, k: int) -> str:
        if k < self.field.symbol_count:
            return self.field.names[k]
        if k not in self._atoms:
            atom = self.field.atoms[k]
            inside = self.function(atom.argument)
            self._atoms[k] = f"|{inside}|" if atom.kind == "fabs" else f"{atom.kind}({inside})"
        return self._atoms[k]

    def function(self, function: Quotient) -> str:
        if function.is_zero():
            return "0"
        groups = self.coefficients.split_sparsely(function)
        if groups is None:
            return self._ratio(function.numerator, function.denominator)
        shown = [self._term(groups[state], self._power_product(state)) for state in sorted(groups, key=descending)]
        text = shown[0]
        for term in shown[1:]:
            text += f" - {term[1:]}" if term.startswith("-") else f" + {term}"
        return text

    def _term(self, coefficient: Quotient, product: str) -> str:
        constant = coefficient.constant()
        if constant is not None:
            if not product:
                return number(fraction(constant))
            if abs(constant) == 1:
                return product if constant > 0 else f"-{product}"
            return f"{number(fraction(constant))}*{product}"
        text = self._ratio(coefficient.numerator, coefficient.denominator)
        if not product:
            return text
        for one, sign in (("1/", ""), ("-1/", "-")):
            if text.startswith(one) and "*" not in _outside(text):
                return f"{sign}{product}/{text[len(one) :]}"
        return f"({text})*{product}" if " " in _outside(text) else f"{text}*{product}"

    def _ratio(self, numerator: fmpq_mpoly, denominator: fmpq_mpoly) -> str:
        above, below = (fraction(fmpq(polynomial.factor()[0])) for polynomial in (numerator, denominator))
        if below != 1:  # factors on both sides would hide how simple the ratio is
            ratio = above / below
            short = max(abs(ratio.numerator), ratio.denominator) < _SHORT
            numerator *= rational((ratio.numerator if short else ratio) / above)
            denominator *= rational((ratio.denominator if short else 1) / below)
        top = self._factored(numerator)
        if denominator.is_constant():
            return top
        top = f"({top})" if " " in _outside(top) else top
        bottom = self._factored(denominator)
        simple = not any(sign in bottom for sign in "*/ ") or (
            bottom.startswith("(") and bottom.count("(") == 1 and bottom.endswith(")")
        )
        return f"{top}/{bottom}" if simple else f"{top}/({bottom})"

    def _factored(self, polynomial: fmpq_mpoly) -> str:
        """The polynomial as a product of its irreducible factors over Q."""
        scale, factors = polynomial.factor()
        parts = []
        for factor, exponent in factors:
            text = self._sum(factor)
            text = f"({text})" if len(factor) > 1 else text
            parts.append(f"{text}^{int(exponent)}" if exponent > 1 else text)
        parts.sort(key=lambda part: (part.startswith("("), part))
        constant = fraction(fmpq(scale))
        if not parts:
            return number(constant)
        sign = "-" if constant < 0 else ""
        if abs(constant) != 1:
            parts.insert(0, number(abs(constant)))
        if len(parts) == 1 and parts[0].startswith("(") and parts[0].endswith(")") and not sign:
            return parts[0][1:-1] if parts[0].count("(") == 1 else parts[0]
        return sign + "*".join(parts)

    def _sum(self, polynomial: fmpq_mpoly) -> str:
        shown = []
        for powers, coefficient in sorted(terms(polynomial), key=lambda term: descending(term[0])):
            product = self._power_product(powers)
            value = fraction(coefficient)
            if not product:
                shown.append(number(value))
            elif abs(value) == 1:
                shown.append(product if value > 0 else f"-{product}")
            else:
                shown.append(f"{number(value)}*{product}")
        return " + ".join(shown).replace("+ -", "- ")

    def _power_product(self, powers: Powers) -> str:
        return "*".join(self.generator(k) if e == 1 else f"{self.generator(k)}^{e}" for k, e in powers)


def _outside(text: str) -> str:
    """What stands outside of all brackets."""
    inner = None
    while inner != text:
        inner, text = text, re.sub(r"\([^()]*\)", "", text)
    return text
