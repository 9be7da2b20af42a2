"""The rational tanh and the doubled cosh against the true ones, in every magnitude."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from flint import arb

from pbcgen.control.hyperbolic import FAST_ERROR, FAST_ULP, default_tanh, fast_cosh, fast_tanh

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
    assert np.max(error / spacing) <= FAST_ULP[precision]
    assert np.max(error) <= FAST_ERROR[precision]


@PRECISIONS
def test_it_is_odd_and_never_beyond_one_for_any_bit_pattern(precision, dtype):
    x = np.frombuffer(np.random.default_rng(2).bytes(400_000), dtype)
    t = evaluate(x)
    assert (np.abs(t) <= 1).all()
    np.testing.assert_array_equal(evaluate(-x)[~np.isnan(x)], -t[~np.isnan(x)])


@PRECISIONS
def test_large_arguments_give_one_and_tiny_ones_themselves(precision, dtype):
    limits = np.finfo(dtype)
    large = np.geomspace(25, float(limits.max) / 2, 10_000).astype(dtype)
    assert (evaluate(np.append(large, dtype(np.inf))) == 1).all()
    tiny = np.array([0, limits.smallest_subnormal, limits.tiny, 1e-20], dtype)
    np.testing.assert_array_equal(evaluate(tiny), tiny)


@pytest.mark.system
@pytest.mark.parametrize("flags", [["-ffp-contract=off"], ["-ffp-contract=fast", "-mfma"]])
def test_every_float_is_within_the_stated_bounds(flags, tmp_path):
    root = Path(__file__).resolve().parents[2]
    source = root / "benchmarks" / "hyperbolic_bound.c"
    package = root / "generated" / "coupling_device"
    names = [
        "-DOUTSIDE=251u",
        '-DPACKAGE="coupling_device.c"',
        "-DTANH=coupling_device_tanh_of_magnitude",
        f"-I{package}",
    ]
    command = ["cc", "-O2", *flags, *names, str(source), "-lm", "-o", str(tmp_path / "bound")]
    if not shutil.which("cc") or subprocess.run(command, capture_output=True, check=False).returncode:
        pytest.skip("no C compiler for this processor")
    found = subprocess.run([str(tmp_path / "bound")], capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stdout
    ulps, absolute = re.search(r"every float: ([\d.]+) ulp, ([\d.e-]+) absolute", found.stdout).groups()
    assert float(ulps) <= FAST_ULP["float"]
    assert float(absolute) <= FAST_ERROR["float"]


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
