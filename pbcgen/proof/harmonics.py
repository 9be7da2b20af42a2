"""Trigonometric polynomials as sums of harmonics: an exact bound that is attained where the harmonics may align.

``sum_w (a_w cos(w^T q) + b_w sin(w^T q))`` over frequencies w differs from its mean by at most the sum of the
amplitudes ``sqrt(a_w^2 + b_w^2)``, each frequency counted once. Its range reaches the bound when the frequencies are
independent.
"""

from __future__ import annotations

from collections.abc import Mapping
from fractions import Fraction
from math import isqrt

from flint import arb

from pbcgen.proof.squares import Square
from pbcgen.symbolic.field import Field, Quotient
from pbcgen.symbolic.real import BITS, fraction, precision, rational, upper

#: Polynomials with more terms, or products with more factors or harmonics, are left alone.
_MOST_TERMS, _MOST_FACTORS, _MOST_HARMONICS = 60, 10, 400

#: Coefficients of exp(i w^T q) by the frequency w, as real and imaginary parts.
_Series = dict[tuple[int, ...], tuple[Fraction, Fraction]]


def harmonic_bounds(function: Quotient) -> tuple[Fraction, Fraction] | None:
    """The mean of a polynomial in sines and cosines, and by how much it differs from that; None for other functions.

    The second number is exact where all amplitudes are rational, and rounded upwards else.
    """
    found = _series(function)
    if found is None:
        return None
    mean, series, _ = found
    return mean, sum((_modulus(a * a + b * b) for a, b in series.values()), Fraction(0))


def harmonic_squares(function: Quotient) -> list[Square] | None:
    """The function as a sum of squares, where its mean is no less than the sum of its amplitudes R; or None.

    ``R + a cos(z) + b sin(z) = ((R cos(z) + a)^2 + (R sin(z) + b)^2 + R^2 - a^2 - b^2) / (2 R)`` for each harmonic.
    """
    found = _series(function)
    if found is None:
        return None
    field, (left, series, angles) = function.field, found
    squares: list[Square] = []
    for w, (real, imaginary) in series.items():
        a, b = 2 * real, -2 * imaginary
        if w < tuple(-k for k in w) or not (a or b):  # the same harmonic again, or none
            continue
        R, z = _modulus(a * a + b * b), field.const(0)
        for count, angle in zip(w, angles, strict=False):
            z = z + angle * field.const(count)
        for wave, shift in ((field.cos(z), a), (field.sin(z), b)):
            squares.append(Square(rational(1 / (2 * R)), (), (wave * field.const(R) + field.const(shift),)))
        left -= R - (R * R - a * a - b * b) / (2 * R)
    if left < 0:
        return None
    return squares + ([Square(rational(left), (), (field.const(1),))] if left else [])


def _series(function: Quotient) -> tuple[Fraction, _Series, list[Quotient]] | None:
    """Mean, harmonics and angles of a polynomial in sines and cosines."""
    terms = function.numerator.to_dict()
    if not function.is_polynomial() or len(terms) > _MOST_TERMS:
        return None
    angles: dict[str, tuple[int, Quotient]] = {}
    series: _Series = {}
    for exponents, coefficient in terms.items():
        product = _product(function.field, {k: int(e) for k, e in enumerate(exponents) if e}, angles)
        if product is None or len(series) > _MOST_HARMONICS:
            return None
        _add(series, product, fraction(coefficient))
    mean = series.pop((0,) * _MOST_FACTORS, (Fraction(0), Fraction(0)))[0]
    return mean, series, [angle for _, angle in angles.values()]


def _product(field: Field, powers: Mapping[int, int], angles: dict[str, tuple[int, Quotient]]) -> _Series | None:
    """A product of powers of sines and cosines; ``angles`` gets a place for each argument."""
    if sum(powers.values()) > _MOST_FACTORS:
        return None
    half = Fraction(1, 2)
    result: _Series = {(0,) * _MOST_FACTORS: (Fraction(1), Fraction(0))}
    for k, power in powers.items():
        atom = field.atoms.get(k)
        if atom is None or atom.kind not in ("sin", "cos"):
            return None
        key = f"{atom.argument.numerator}|{atom.argument.denominator}"
        place, _ = angles.setdefault(key, (len(angles), atom.argument))
        if place >= _MOST_FACTORS:
            return None
        for _ in range(power):
            following: _Series = {}
            for w, (a, b) in result.items():
                for side in (1, -1):
                    turned = (*w[:place], w[place] + side, *w[place + 1 :])
                    # cos = (e + 1/e) / 2, sin = (e - 1/e) / (2 i): the factor 1/i turns (a, b) to (b, -a).
                    part = (a * half, b * half) if atom.kind == "cos" else (b * half * side, -a * half * side)
                    _add(following, {turned: part}, Fraction(1))
            result = following
    return result


def _add(series: _Series, other: _Series, factor: Fraction) -> None:
    for w, (a, b) in other.items():
        before = series.get(w, (Fraction(0), Fraction(0)))
        series[w] = before[0] + a * factor, before[1] + b * factor


def _modulus(square: Fraction) -> Fraction:
    """The square root: exact for squares of rationals, else rounded upwards."""
    top, bottom = isqrt(square.numerator), isqrt(square.denominator)
    if top * top == square.numerator and bottom * bottom == square.denominator:
        return Fraction(top, bottom)
    with precision(BITS):
        return upper(arb(rational(square)).sqrt())
