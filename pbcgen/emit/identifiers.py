r"""Which names a C identifier may have, and what becomes of a name that may not.

The rules, in this order:

1. Greek letters are spelled (``θ`` is ``theta``), other letters lose their accents, and every other character outside
   ``[A-Za-z0-9_]`` becomes ``_``.
2. Underscores at the start are dropped and runs of them become one: such names are reserved in C or C++.
3. A name that is empty or starts with a digit gets ``v_`` in front.
4. Keywords of C and C++, macros of the standard headers and names that common platforms define as macros get ``_``
   behind.
5. Names are cut at 60 characters (C99 guarantees 63).
6. A name that is taken in its scope gets the first free ``_2``, ``_3``, ...

Names that are already legal, unreserved and free stay as they are. User names become members of structs, which share no
name space with functions, so that ``gamma`` or ``y1`` need no renaming.

>>> Scope().claim("theta_1"), Scope().claim("θ̇ [rad/s]"), Scope().claim("class"), Scope().claim("1st")
('theta_1', 'theta_rad_s', 'class_', 'v_1st')
>>> scope = Scope()
>>> [scope.claim(name) for name in ("x c", "x_c", "x.c")]
['x_c', 'x_c_2', 'x_c_3']
"""

from __future__ import annotations

import re
import unicodedata
from dataclasses import dataclass, field
from typing import Final

from pbcgen.errors import EmitError

MAX_LENGTH: Final = 60
#: Functions of a package differ within its prefix and seven characters more; C99 compares 31 of external names.
MAX_PREFIX: Final = 24

_C_KEYWORDS: Final = """
    auto break case char const continue default do double else enum extern float for goto if inline int long register
    restrict return short signed sizeof static struct switch typedef union unsigned void volatile while alignas alignof
    bool constexpr false nullptr static_assert thread_local true typeof typeof_unqual asm fortran
"""
_CPP_KEYWORDS: Final = """
    alignas alignof and and_eq asm atomic_cancel atomic_commit atomic_noexcept auto bitand bitor bool catch char8_t
    char16_t char32_t class co_await co_return co_yield compl concept const_cast consteval constexpr constinit
    contract_assert decltype delete dynamic_cast explicit export false final friend import module mutable namespace new
    noexcept not not_eq nullptr operator or or_eq override private protected public reflexpr reinterpret_cast requires
    static_assert static_cast synchronized template this thread_local throw true try typeid typename using virtual
    wchar_t xor xor_eq
"""
_STANDARD_MACROS: Final = """
    HUGE_VAL HUGE_VALF HUGE_VALL INFINITY NAN DECIMAL_DIG MATH_ERRNO MATH_ERREXCEPT math_errhandling
    NULL EOF BUFSIZ FILENAME_MAX FOPEN_MAX L_tmpnam TMP_MAX RAND_MAX EXIT_FAILURE EXIT_SUCCESS MB_CUR_MAX CLOCKS_PER_SEC
    CHAR_BIT CHAR_MAX CHAR_MIN I complex imaginary _Complex_I errno assert stdin stdout stderr signal offsetof
    noreturn DOMAIN SING OVERFLOW UNDERFLOW PLOSS TLOSS
"""
#: Object-like macros that compilers or vendor headers define without asking.
_PLATFORM_MACROS: Final = """
    linux unix i386 sun vax mips arm near far cdecl pascal interface small hyper IN OUT OPTIONAL CONST VOID TRUE FALSE
    ERROR PI HALF_PI TWO_PI EULER HIGH LOW INPUT OUTPUT SDA SCL DEFAULT signals slots emit foreach forever
"""
#: Macros by pattern: limits of stdint.h and limits.h, classes of math.h, errno.h, POSIX constants of math.h.
_MACRO_PATTERN: Final = re.compile(
    r"(U?INT(_(LEAST|FAST))?\d+_(MAX|MIN|C)|U?INT(PTR|MAX)_(MAX|MIN|C)|(SIZE|PTRDIFF|SIG_ATOMIC|WCHAR|WINT)_(MAX|MIN)"
    r"|U?(CHAR|SHRT|INT|LONG|LLONG)_(MAX|MIN)|SCHAR_(MAX|MIN)|(FLT|DBL|LDBL)_[A-Z0-9_]*[A-Z0-9]|F[PE]_[A-Z0-9_]*[A-Z0-9]"
    r"|M_[A-Z0-9_]*[A-Z0-9]|E[A-Z]{2,}[A-Z0-9]*|SIG[A-Z]+|LC_[A-Z]+|PRI[a-zX][A-Z0-9]+|SCN[a-zX][A-Z0-9]+)"
)
#: Type names of stdint.h and relatives, which a member could hide.
_TYPE_PATTERN: Final = re.compile(
    r"u?int(_(least|fast))?\d+_t|u?int(ptr|max)_t|(size|ssize|ptrdiff|float|double|wchar)_t"
)

RESERVED: Final[frozenset[str]] = frozenset((_C_KEYWORDS + _CPP_KEYWORDS + _STANDARD_MACROS + _PLATFORM_MACROS).split())

_HEADERS_AND_TARGETS: Final = """
    assert complex ctype errno fenv float inttypes iso646 limits locale math setjmp signal stdalign stdarg stdatomic
    stdbool stddef stdint stdio stdlib stdnoreturn string strings tgmath threads time uchar wchar wctype unistd
    algorithm array atomic bitset chrono cmath deque exception functional iostream list map memory new numeric queue
    random ratio set stack thread tuple utility valarray vector version
    all build clean example help install lib test package edit_cache rebuild_cache c m gcc
    fp fe sig lc flt dbl ldbl
"""

#: A prefix names a header, a library and a build target too, and its upper case starts the status names.
RESERVED_PREFIXES: Final[frozenset[str]] = frozenset(_HEADERS_AND_TARGETS.split())

_GREEK_NAMES: Final = """
    alpha beta gamma delta epsilon zeta eta theta iota kappa lambda mu nu xi omicron pi rho sigma tau upsilon phi chi
    psi omega
"""
_GREEK: Final = dict(zip("αβγδεζηθικλμνξοπρστυφχψω", _GREEK_NAMES.split(), strict=True)) | {
    "ς": "sigma",
    "ϑ": "theta",
    "ϕ": "phi",
    "ϵ": "epsilon",
    "µ": "mu",
}


def legal(name: str) -> str:
    """The identifier that rules 1 to 5 make of ``name``; ``name`` itself when it is one.

    >>> legal("R_θ"), legal("__x"), legal(""), legal("é"), legal("INT8_MAX"), legal("Ω")
    ('R_theta', 'x', 'v_', 'e', 'INT8_MAX_', 'Omega')
    """
    text = re.sub(r"_+", "_", re.sub(r"[^A-Za-z0-9_]", "_", spell(name))).lstrip("_")
    if text != name:
        text = text.rstrip("_")
    if not text or text[0].isdigit():
        text = f"v_{text}"
    text = text[:MAX_LENGTH]
    return f"{text}_" if is_reserved(text) else text


def is_reserved(name: str) -> bool:
    """Whether rule 4 applies.

    >>> is_reserved("xor"), is_reserved("M_PI"), is_reserved("int8_t"), is_reserved("gamma")
    (True, True, True, False)
    """
    return name in RESERVED or bool(_MACRO_PATTERN.fullmatch(name) or _TYPE_PATTERN.fullmatch(name))


@dataclass
class Scope:
    """Names in use in one C name space; grows while names are claimed."""

    taken: set[str] = field(default_factory=set)

    def claim(self, name: str) -> str:
        """A legal identifier for ``name`` that nobody has, now taken."""
        base = legal(name)
        candidate, number = base, 1
        while candidate in self.taken:
            number += 1
            candidate = f"{base.rstrip('_')}_{number}"
        self.taken.add(candidate)
        return candidate


def package_prefix(requested: str | None, design: str) -> str:
    """The prefix of a package: the requested one, else one made of the design's name in lower case.

    Raises EmitError if the requested prefix cannot name C functions, a header and a library.

    >>> package_prefix(None, "Coupling device"), package_prefix(None, "math"), package_prefix("Arm2", "arm")
    ('coupling_device', 'math_control', 'Arm2')
    """
    if requested is None:
        prefix = legal(design.lower())[:MAX_PREFIX].rstrip("_")
        if prefix.startswith(_ARDUINO):
            prefix = f"c_{prefix}"[:MAX_PREFIX].rstrip("_")
        return f"{prefix}_control" if prefix in RESERVED_PREFIXES | RESERVED else prefix
    suggestion = package_prefix(None, requested)
    if requested != legal(requested) or requested.endswith("_"):
        raise EmitError(f"the prefix `{requested}` is not a free C identifier: use for example `{suggestion}`")
    if requested.lower() in RESERVED_PREFIXES:
        raise EmitError(f"the prefix `{requested}` names a standard header or build target: use `{suggestion}`")
    if requested.lower().startswith(_ARDUINO):
        raise EmitError(f"the prefix `{requested}` names a library of the Arduino project: use `{suggestion}`")
    if len(requested) > MAX_PREFIX:
        raise EmitError(f"the prefix `{requested}` is longer than {MAX_PREFIX} characters: choose a shorter one")
    return requested


#: Only libraries of the Arduino project may have names that start like this.
_ARDUINO: Final = "arduino"


def spell(name: str) -> str:
    """The text ``name`` with Greek letters spelled and accents dropped."""
    spelled = []
    for character in unicodedata.normalize("NFD", name):
        if character.lower() in _GREEK:
            letter = _GREEK[character.lower()]
            spelled.append(letter.capitalize() if character != character.lower() else letter)
        elif not unicodedata.combining(character):
            spelled.append(unicodedata.normalize("NFKD", character))
    return "".join(spelled)
