"""What header, README and manifest say in words."""

from __future__ import annotations

import re
import textwrap
from fractions import Fraction
from typing import TYPE_CHECKING, Final

from pbcgen.emit.identifiers import spell
from pbcgen.law.arithmetic import Precision
from pbcgen.law.law import ControlLaw, Fallback, Signal
from pbcgen.law.rounding import STATE_LIMIT
from pbcgen.law.step import StepStatus
from pbcgen.proof.claim import CLAIMS

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

WIDTH: Final = 116

#: What it means that a claim is not proved.
UNPROVED: Final[dict[str, str]] = {
    "input-rank": "the input matrix was not proved to have full column rank",
    "equilibrium": "the target was not proved to be an equilibrium under the equilibrium input",
    "assumption-1": "the storage was not proved to decrease without input (Assumption 1)",
    "passive-output": "no function gamma was proved to give a passive output",
    "gradient-condition": "the target was not proved to be a critical point of the closed-loop storage",
    "hessian-condition": "the closed-loop storage was not proved to have a strict minimum at the target",
    "gain-definiteness": "the gains were not proved to be positive definite",
    "kc-bound": "the gain K_c was not proved to be large enough",
    "assumption-3": "no function eta was proved to meet Assumption 3",
    "theta": "the matrix Theta was not proved to be positive semidefinite",
    "measurability": "the law was not proved to need only measured signals",
    "saturation": "the law was not proved to respect the limits of the actuators",
    "stable": "the closed loop was not proved to be stable",
    "asymptotically-stable": "the closed loop was not proved to be asymptotically stable",
    "globally-asymptotically-stable": "the closed loop was not proved to be globally asymptotically stable",
    "sampled-stable": "the loop was not proved to be stable at this sample period",
    "adjustable": "the claims were not proved for every target and gain that may be set",
}

_STATUS_MEANINGS: Final[dict[StepStatus, str]] = {
    StepStatus.OK: "the step was computed",
    StepStatus.NOT_CONVERGED: "the loop equation missed its tolerance; state and outputs were updated all the same",
    StepStatus.STATE_RESET: "the state was not finite or beyond its limit; it was set to its initial value first",
    StepStatus.OUT_OF_RANGE: "the computation overflowed; the state was kept, the outputs are {fallback}",
    StepStatus.INVALID_INPUT: "a measurement is NaN or beyond {limit}; the state was kept, the outputs are {fallback}",
    StepStatus.INVALID_ARGUMENT: "a pointer is null; nothing was read, the outputs are {equilibrium}",
    StepStatus.INVALID_SETTING: "a target or gain is outside its range or NaN; nothing was changed (by setters only)",
}

#: Rules of MISRA C:2012 that the code does not follow, and why.
DEVIATIONS: Final[dict[str, str]] = {
    "2.5": "the macros of the header are for the user",
    "8.7": "the functions of the interface are called from other files",
    "11.9": "null pointers are compared with 0, so that no further header is needed",
    "12.1": "products in sums stand without parentheses, as in any formula",
    "15.4": "the solver of a block leaves its loop in two places",
    "15.5": "a refused step returns at once",
}

EQUILIBRIUM_TEXT: Final = "the equilibrium input"


def status_meaning(status: StepStatus, law: ControlLaw) -> str:
    """What ``status`` says of a step of ``law``; with a remark where this law never reports it."""
    limit = f"{float(STATE_LIMIT[law.precision]):.2g}"
    meaning = _STATUS_MEANINGS[status].format(fallback=fallback_text(law), equilibrium=EQUILIBRIUM_TEXT, limit=limit)
    blocks = any(hasattr(solve, "indices") for solve in law.solves)
    keeps = bool(law.states) or law.fallback is Fallback.LAST_OUTPUT
    never = (status is StepStatus.NOT_CONVERGED and not blocks) or (status is StepStatus.STATE_RESET and not keeps)
    return f"{meaning} (this law never reports it)" if never else meaning


def fallback_text(law: ControlLaw) -> str:
    """The outputs of an invalid step, in words."""
    return "the last valid outputs" if law.fallback is Fallback.LAST_OUTPUT else EQUILIBRIUM_TEXT


def unproved(claim: str) -> str:
    """A sentence for a claim that was allowed without proof."""
    if claim not in CLAIMS:
        return f"the claim `{claim}` was not proved"
    return UNPROVED[claim]


def number(value: Fraction) -> str:
    """``value`` exactly if it is a short decimal or fraction, else to 9 digits.

    >>> number(Fraction(1, 1000)), number(Fraction(-31, 10)), number(Fraction(1, 3)), number(Fraction(2**70, 3))
    ('0.001', '-3.1', '1/3', 'about 3.9353054e+20')
    """
    shortest = repr(float(value)) if abs(value) < Fraction(10) ** 300 else ""
    if shortest and Fraction(shortest) == value:
        return shortest.removesuffix(".0")
    fraction = str(value)
    return fraction if len(fraction) <= 12 else f"about {float(value):.9g}"


def timing(delay: Fraction, jitter: Fraction) -> str:
    """What the verdicts on the sampled loop assume of the firmware.

    >>> timing(Fraction(0), Fraction(0)), timing(Fraction(1, 2), Fraction(1, 20))
    ('outputs act at once, periods do not vary', 'outputs act 0.5 periods late, periods vary by up to 5 %')
    """
    late = f"outputs act {number(delay)} period{'s' * (delay != 1)} late" if delay else "outputs act at once"
    return f"{late}, periods {f'vary by up to {number(100 * jitter)} %' if jitter else 'do not vary'}"


def value(literal: str) -> str:
    """A C literal as a number in prose.

    >>> value("1e-05f"), value("0.5")
    ('1e-05', '0.5')
    """
    return literal.removesuffix("f")


def horner_in(coefficients: Sequence[str], variable: str, *, outer: bool = False) -> str:
    """The polynomial with these coefficients, from the highest down; as a factor unless ``outer``.

    >>> horner_in(("1.0f", "-2.0f", "3.0f"), "y"), horner_in(("-2.0f",), "y")
    ('((1.0f * y - 2.0f) * y + 3.0f)', '-2.0f')
    """
    text = coefficients[0]
    for k, coefficient in enumerate(coefficients[1:]):
        factor = f"({text})" if k else text
        sign = "-" if coefficient.startswith("-") else "+"
        text = f"{factor} * {variable} {sign} {coefficient.removeprefix('-')}"
    return text if outer or len(coefficients) == 1 else f"({text})"


def horner_of(array: str, first: int, count: int, variable: str, *, monic: bool = False) -> str:
    """The polynomial whose coefficients, from the highest down, are entries of an array, behind a one if it is monic.

    >>> horner_of("k", 0, 3, "y"), horner_of("k", 3, 2, "y", monic=True)
    ('(k[0] * y + k[1]) * y + k[2]', '(y + k[3]) * y + k[4]')
    """
    entries = [f"{array}[{k}]" for k in range(first, first + count)]
    if monic:
        entries[0] = f"({variable} + {entries[0]})"
    return horner_in(entries, variable, outer=True)


def sum_of_squares(values: Sequence[str], indent: str) -> str:
    """``((a * a) + (b * b))``, broken into lines of four terms.

    >>> sum_of_squares(("a", "b"), "")
    '((a * a) + (b * b))'
    """
    terms = [f"({v} * {v})" for v in values]
    lines = [" + ".join(terms[k : k + 4]) for k in range(0, len(terms), 4)]
    return "(" + f"\n{indent}+ ".join(lines) + ")"


def interval(bounds: tuple[Fraction, Fraction] | None, unit: str = "") -> str:
    """``[lo, hi] unit``, empty for no bounds."""
    if bounds is None:
        return ""
    return f"[{number(bounds[0])}, {number(bounds[1])}]" + (f" {unit}" if unit else "")


#: Characters of units and prose that have a better spelling than their ASCII base letter.
_ASCII: Final = {
    "\N{OHM SIGN}": "Ohm",
    "\N{GREEK CAPITAL LETTER OMEGA}": "Ohm",
    "\N{MICRO SIGN}": "u",
    "\N{GREEK SMALL LETTER MU}": "u",
    "\N{DEGREE SIGN}": "deg",
    "\N{SUPERSCRIPT TWO}": "^2",
    "\N{SUPERSCRIPT THREE}": "^3",
    "\N{MIDDLE DOT}": "*",
    "\N{DOT OPERATOR}": "*",
    "\N{MULTIPLICATION SIGN}": "x",
    "\N{MINUS SIGN}": "-",
    "\N{EN DASH}": "-",
    "\N{EM DASH}": "-",
    "\N{LESS-THAN OR EQUAL TO}": "<=",
    "\N{GREATER-THAN OR EQUAL TO}": ">=",
    "\N{LEFT SINGLE QUOTATION MARK}": "'",
    "\N{RIGHT SINGLE QUOTATION MARK}": "'",
    "\N{LEFT DOUBLE QUOTATION MARK}": '"',
    "\N{RIGHT DOUBLE QUOTATION MARK}": '"',
    "\N{SUPERSCRIPT MINUS}": "^-",
    "\N{SUPERSCRIPT ONE}": "1",
}


def plain(text: str) -> str:
    r"""``text`` as it may stand in a C comment or a table cell: one line of printable ASCII.

    >>> plain("speed */ in µm/s"), plain("a\nb  c"), plain("é ψ ??/")
    ('speed * / in um/s', 'a b c', 'e psi ? ?/')
    """
    spelled = "".join(_ASCII.get(character, character) for character in text)
    letters = spell(spelled).encode("ascii", "replace").decode()
    line = " ".join(re.sub(r"[\x00-\x1f\x7f]", " ", letters).split())
    for opening in ("*/", "/*", "??"):
        while opening in line:
            line = line.replace(opening, f"{opening[0]} {opening[1]}")
    return line.replace("\\", "/")


def code_points(text: str) -> str:
    """``text`` with every character outside printable ASCII named by its code point.

    >>> code_points("θ_1")
    '<U+03B8>_1'
    """
    return "".join(c if " " <= c <= "~" else f"<U+{ord(c):04X}>" for c in text)


def cell(text: str) -> str:
    r"""``text`` in a Markdown table: plain, without markup.

    >>> print(cell("|u| <= 3 *V*"))
    \|u\| &lt;= 3 \*V\*
    """
    escaped = re.sub(r"([|*_`\[\]])", r"\\\1", plain(text))
    return escaped.replace("<", "&lt;").replace(">", "&gt;")


def remark(signal: Signal) -> str:
    """Unit and description as a comment behind a member, empty if there is neither.

    >>> remark(Signal("q", "rad", "joint angle")), remark(Signal("q"))
    (' /* rad; joint angle */', '')
    """
    text = "; ".join(plain(part) for part in (signal.unit, signal.description) if part)
    return f" /* {text} */" if text else ""


def wrap(text: str, indent: str = "") -> list[str]:
    """Lines of ``text`` for a comment; continued lines are indented by ``indent``."""
    return textwrap.wrap(plain(text), WIDTH, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)


def table(rows: Iterable[Sequence[str]], indent: str = "  ") -> list[str]:
    """Rows as aligned columns; columns that are empty everywhere are left out."""
    cells = [[plain(cell) for cell in row] for row in rows]
    if not cells:
        return []
    widths = [max(len(row[k]) for row in cells) for k in range(len(cells[0]))]
    shown = [k for k, width in enumerate(widths) if width]
    return [indent + "  ".join(row[k].ljust(widths[k]) for k in shown).rstrip() for row in cells]


def precision_text(precision: Precision) -> str:
    """The arithmetic in words."""
    return "float (IEEE 754 binary32)" if precision == "float" else "double (IEEE 754 binary64)"
