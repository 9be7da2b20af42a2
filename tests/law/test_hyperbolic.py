"""The rational tanh and the doubled cosh against the true ones, in every magnitude."""

from __future__ import annotations

import contextlib
import math
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from flint import arb

from benchmarks.tanh_bound import proved
from pbcgen import pipeline
from pbcgen.law.arithmetic import default_tanh
from pbcgen.law.hyperbolic import (
    DENOMINATOR,
    FAST_ERROR,
    FAST_SEEN,
    FAST_ULP,
    LIBM_ULP,
    NUMERATOR,
    fast_cosh,
    fast_tanh,
)
from pbcgen.models.loader import load

PRECISIONS = pytest.mark.parametrize(("precision", "dtype"), [("float", np.float32), ("double", np.float64)])


def evaluate(x):
    with np.errstate(all="ignore"):
        return fast_tanh(x)


def sample(dtype):
    """Every exponent, dense where tanh bends and where it saturates."""
    rng = np.random.default_rng(1)
    limits = np.finfo(dtype)
    exponents = np.exp2(np.arange(limits.minexp, limits.maxexp, dtype=float))
    values = np.concatenate([exponents, np.linspace(0.01, 20, 4000), 10 ** rng.uniform(-8, 1.5, 4000)])
    return values.astype(dtype)


@PRECISIONS
def test_the_error_is_within_the_stated_bounds(precision, dtype):
    x = sample(dtype)
    found = evaluate(x)
    exact = [arb(float(v)).tanh() for v in x]
    error = np.array([abs(float(arb(float(t)) - e)) for t, e in zip(found, exact, strict=True)])
    spacing = np.spacing(np.array([float(e) for e in exact]).astype(dtype))
    seen = {"float": (FAST_ULP["float"], FAST_ERROR["float"]), "double": FAST_SEEN}[precision]
    assert np.max(error / spacing) <= seen[0]
    assert np.max(error) <= seen[1]


@PRECISIONS
def test_a_bound_is_proved_on_the_whole_line(precision, dtype):
    bound = proved(precision)
    assert np.isfinite(dtype(bound.ulp))
    if precision == "double":
        assert bound.ulp <= FAST_ULP["double"]
        assert bound.absolute <= FAST_ERROR["double"]
    assert FAST_ULP["float"] <= bound.ulp <= 53


def test_the_proof_sees_a_changed_coefficient(monkeypatch):
    good = proved("double").ulp
    for k, change in ((1, 1 + 1e-14), (5, 1 + 1e-11), (9, 1 - 1e-6)):
        values = list(NUMERATOR["double"])
        values[k] *= change
        monkeypatch.setitem(NUMERATOR, "double", tuple(values))
        with contextlib.suppress(ArithmeticError):
            assert proved("double").ulp > good + 1
        monkeypatch.undo()


def test_the_proof_holds_for_operations_rounded_at_their_worst():
    """Every operation rounded towards the side that moves the result most stays within what rounding may add."""
    x = np.linspace(0.01, 19, 2001)
    y = x * x
    up, down = 1 + 2.0**-53, 1 - 2.0**-53
    p, q = np.full_like(y, NUMERATOR["double"][-1]), np.ones_like(y)
    for a, b in zip(NUMERATOR["double"][-2::-1], DENOMINATOR["double"][::-1], strict=True):
        p, q = (p * y * up + a) * up, (q * y * down + b) * down
    worst = np.minimum(1, x * p / q * up * up)
    assert np.max(np.abs(worst - np.tanh(x))) <= FAST_ERROR["double"]


def test_the_math_library_is_as_near_as_stated():
    x = sample(np.float64)
    exact = [arb(v).tanh() for v in x]
    error = np.array([abs(float(arb(math.tanh(v)) - e)) for v, e in zip(x, exact, strict=True)])
    assert np.max(error / np.spacing(np.array([float(e) for e in exact]))) <= LIBM_ULP["double"]


@PRECISIONS
def test_it_is_odd_and_at_most_one_for_every_finite_number(precision, dtype):
    x = np.frombuffer(np.random.default_rng(2).bytes(400_000), dtype)
    t = evaluate(x)
    finite = np.isfinite(x)
    assert (np.abs(t[finite]) <= 1).all()
    assert np.isnan(t[~finite]).all()
    np.testing.assert_array_equal(evaluate(-x)[finite], -t[finite])


@PRECISIONS
def test_large_arguments_give_one_and_tiny_ones_themselves(precision, dtype):
    limits = np.finfo(dtype)
    large = np.geomspace(25, float(limits.max) / 2, 10_000).astype(dtype)
    assert (evaluate(np.append(large, limits.max)) == 1).all()
    tiny = np.array([0, limits.smallest_subnormal, limits.tiny, 1e-20], dtype)
    np.testing.assert_array_equal(evaluate(tiny), tiny)


@pytest.mark.system
@pytest.mark.parametrize("flags", [["-ffp-contract=off"], ["-ffp-contract=fast", "-mfma"]])
def test_every_float_is_within_the_stated_bounds(flags, tmp_path):
    package = Path(__file__).resolve().parents[2] / "generated" / "coupling_device"
    names = ['-DPACKAGE="coupling_device.c"', "-DTANH=coupling_device_tanh", f"-I{package}"]
    ulps, absolute = measured_on_every_float([*flags, *names], tmp_path)
    assert ulps <= FAST_ULP["float"]
    assert absolute <= FAST_ERROR["float"]


@pytest.mark.system
def test_every_float_of_the_math_library_is_as_near_as_stated_and_at_most_one(tmp_path):
    report = pipeline.check(load("rlc"))
    package = pipeline.package(replace(report, tanh="libm"))
    assert "2.2 units in the last place" in package.files["README.md"]
    for name in ("rlc.h", "rlc.c"):
        (tmp_path / name).write_text(package.files[name])
    names = ['-DPACKAGE="rlc.c"', "-DTANH=rlc_tanh", "-DLIBM", f"-I{tmp_path}"]
    ulps, _ = measured_on_every_float(names, tmp_path)
    assert ulps <= LIBM_ULP["float"]


def measured_on_every_float(options: list[str], directory: Path) -> tuple[float, float]:
    """Units in the last place and absolute error of a package's tanh."""
    source = Path(__file__).resolve().parents[2] / "benchmarks" / "hyperbolic_bound.c"
    command = ["cc", "-O2", "-DOUTSIDE=251u", *options, str(source), "-lm", "-o", str(directory / "bound")]
    if not shutil.which("cc") or subprocess.run(command, capture_output=True, check=False).returncode:
        pytest.skip("no C compiler for this processor")
    found = subprocess.run([str(directory / "bound")], capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stdout
    ulps, absolute = re.search(r"every float: ([\d.]+) ulp, ([\d.e-]+) absolute", found.stdout).groups()
    return float(ulps), float(absolute)


def test_float_is_fast_by_default_and_double_is_not():
    assert (default_tanh("float"), default_tanh("double")) == ("fast", "libm")


def test_cosh_is_even_and_within_its_bound_up_to_overflow():
    x = np.linspace(-88.7, 88.7, 100_001).astype(np.float32)
    found = fast_cosh(x)
    np.testing.assert_array_equal(found, fast_cosh(-x))
    error = np.abs(found / np.cosh(x.astype(np.float64)) - 1)
    assert (error <= (4 + 2 * np.abs(x)) * 2.0**-23).all()
    assert (found >= 1).all()


def test_cosh_overflows_to_infinity_and_keeps_nan():
    with np.errstate(all="ignore"):
        found = fast_cosh(np.array([0, 100, -1e30, np.inf, np.nan], np.float32))
    np.testing.assert_array_equal(found, [1, np.inf, np.inf, np.inf, np.nan])
