"""Where in the user's file something was written, so that messages can point at it."""

from __future__ import annotations

import ast
import linecache
import os
import re
import sys
from dataclasses import dataclass
from pathlib import Path
from types import CodeType, FrameType, TracebackType
from typing import TYPE_CHECKING

from pbcgen.errors import Place

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from pbcgen.errors import PbcgenError

_PACKAGE = Path(__file__).resolve().parent.parent
_EXAMPLES = _PACKAGE / "examples"

#: Words of messages that stand for an argument of another name.
_ALSO_CALLED = {"gain": "law", "sample period": "sample_period", "initial state": "initial", "inertia": "M"}


#: For each claim the arguments that decide it, the likeliest first.
_DECIDED_BY = {
    "input-rank": ("G", "g", "g_L", "g_C"),
    "equilibrium": ("target",),
    "assumption-1": ("D", "S", "v_R", "i_G"),
    "passive-output": ("gamma",),
    "gradient-condition": ("target",),
    "hessian-condition": ("beta", "beta_c", "law"),
    "gain-definiteness": ("K_c", "law"),
    "kc-bound": ("K_c", "law"),
    "assumption-3": ("eta", "law"),
    "theta": ("K_l", "law"),
    "measurability": ("measured",),
    "saturation": ("alpha", "alpha_c", "law"),
    "sampled-stable": ("sample_period",),
    "adjustable": ("target_box", "gain_ranges"),
}


@dataclass(frozen=True)
class Call:
    """A call in the user's file.

    Attributes:
        file: its path.
        line: where the call starts.
        last_line: where it ends.
        column: where it starts in its line, in bytes.
        parameters: names of the arguments that can be given by position.
    """

    file: str
    line: int
    last_line: int
    column: int
    parameters: tuple[str, ...] = ()

    def place(self, line: int | None = None) -> Place:
        """A line of the call, its first if none is given."""
        number = line or self.line
        linecache.checkcache(self.file)
        return Place(_shown(self.file), number, linecache.getline(self.file, number).strip())

    def argument(self, names: Iterable[str]) -> Place | None:
        """Where the first of these arguments stands that the call has, and its text; also those of calls inside it."""
        found = self._arguments()
        return next((self._text_of(found[name]) for name in names if name in found), None)

    def _text_of(self, node: ast.keyword | ast.expr) -> Place:
        source = "".join(linecache.getlines(self.file))
        return Place(_shown(self.file), node.lineno, " ".join((ast.get_source_segment(source, node) or "").split()))

    def named_in(self, message: str) -> Place:
        """The line of the argument that the message names first, or the first line of the call."""
        found = self.mention(message)
        return self.place(None if found is None else found[1])

    def mention(self, message: str) -> tuple[int, int] | None:
        """Where the message first names an argument of the call, and the line of that argument."""
        lines = {name: node.lineno for name, node in self._arguments().items()}
        meant = {name: name for name in lines if name != "a"}  # the article
        meant |= {word: name for word, name in _ALSO_CALLED.items() if name in lines}
        found = [(match.start(), lines[meant[w]]) for w in meant if (match := re.search(rf"\b{w}\b", message))]
        return min(found, default=None)

    def _arguments(self) -> dict[str, ast.keyword | ast.expr]:
        """The arguments by name, those of the call itself before those of calls inside it."""
        node = self._node()
        if node is None:
            return {}
        found: dict[str, ast.keyword | ast.expr] = dict(zip(self.parameters, node.args, strict=False))
        calls = [item for item in ast.walk(node) if isinstance(item, ast.Call)]  # breadth first
        for keyword in (keyword for call in calls for keyword in call.keywords if keyword.arg):
            found.setdefault(str(keyword.arg), keyword)
        return found

    def _node(self) -> ast.Call | None:
        linecache.checkcache(self.file)
        try:
            tree = ast.parse("".join(linecache.getlines(self.file)))
        except (SyntaxError, ValueError):
            return None
        wanted = (self.line, self.column, self.last_line)
        calls = (node for node in ast.walk(tree) if isinstance(node, ast.Call))
        return next((c for c in calls if (c.lineno, c.col_offset, c.end_lineno) == wanted), None)


def users_call() -> Call | None:
    """The call of pbcgen by the user's code that is being executed; None for a built-in model."""
    callee: FrameType = sys._getframe(1)
    frame: FrameType | None = callee
    while frame is not None and _ours(frame.f_code.co_filename):
        callee, frame = frame, frame.f_back
    if frame is None or not frame.f_code.co_filename.endswith(".py") or _built_in(frame.f_code.co_filename):
        return None
    return _call(frame.f_code, frame.f_lasti, frame.f_lineno, callee.f_code)


def called_by_user(depth: int = 2) -> bool:
    """Whether the caller of the function that asks is not pbcgen itself."""
    return not _ours(sys._getframe(depth).f_code.co_filename)


def failing_call(trace: TracebackType | None, path: Path) -> Call | None:
    """The innermost call in the user's files that an error passed through: the file itself, or one beside it."""
    frames = list(_frames(trace))
    own = path.resolve()
    for k, (code, instruction, line) in reversed(list(enumerate(frames))):
        file = Path(code.co_filename)
        if file == own or (own.parent in file.parents and not _ours(str(file)) and "site-packages" not in file.parts):
            callee = frames[k + 1][0] if k + 1 < len(frames) else None
            return _call(code, instruction, line, callee)
    return None


def located(error: PbcgenError, *calls: Call | None) -> PbcgenError:
    """The error with the place that it speaks of, if it has none yet: the argument of a call that it names first."""
    known = [call for call in calls if call is not None]
    if error.place is None and known:
        named = {found: call for call in known if (found := call.mention(error.message))}
        error.place = named[min(named)].place(min(named)[1]) if named else known[0].place()
    return error


def deciding_line(claim: str, *calls: Call | None) -> Place | None:
    """Where the argument stands that decides the claim, if the calls have it."""
    found = (call.argument(_DECIDED_BY.get(claim, ())) for call in calls if call is not None)
    return next(filter(None, found), None)


def _frames(trace: TracebackType | None) -> Iterator[tuple[CodeType, int, int]]:
    while trace is not None:
        yield trace.tb_frame.f_code, trace.tb_lasti, trace.tb_lineno
        trace = trace.tb_next


def _call(code: CodeType, instruction: int, line: int, callee: CodeType | None) -> Call:
    first, last, column, _ = list(code.co_positions())[instruction // 2]
    names = () if callee is None else callee.co_varnames[: callee.co_argcount]
    parameters = tuple(name for name in names if name not in {"self", "cls"})
    return Call(code.co_filename, first or line, last or line, column or 0, parameters)


def _ours(file: str) -> bool:
    path = Path(file)
    return (_PACKAGE in path.parents and not _built_in(file)) or not path.name.endswith(".py")


def _built_in(file: str) -> bool:
    return _EXAMPLES in Path(file).parents


def _shown(file: str) -> str:
    """The path as short as it can be said from here."""
    relative = os.path.relpath(file)
    return file if relative.startswith("..") else relative
