"""The compiled step against the reference step, on ordinary and on impossible numbers."""

from __future__ import annotations

import itertools
from dataclasses import replace

import cffi
import hand_made_laws as laws
import numpy as np
import pytest
from compiled import Compiled, compiler, run

from pbcgen.emit import render
from pbcgen.law.law import Fallback, VectorSolve
from pbcgen.law.rounding import STATE_LIMIT
from pbcgen.law.solves import with_tanh
from pbcgen.law.step import ReferenceStep, StepStatus

#: The compiled packages are shared by the tests of one process.
pytestmark = [pytest.mark.system, pytest.mark.xdist_group("compiled step")]

LAWS = {
    "two_channels": laws.two_channels,
    "two_channels_holding": lambda precision: laws.two_channels(precision, Fallback.LAST_OUTPUT),
    "block": laws.block,
    "stiff_block": lambda precision: laws.block(precision, stiffness=2000.0),
    "soft_block": lambda precision: laws.block(precision, size=5, stiffness=0.01),
    "mixed": laws.mixed,
    "stateless": laws.stateless,
    "constant_channels": laws.constant_channels,
    "fast_channels": lambda precision: with_tanh(laws.two_channels(precision), "fast"),
    "fast_block": lambda precision: with_tanh(laws.block(precision), "fast"),
}


@pytest.fixture(scope="module", params=[(name, p) for name in LAWS for p in ("float", "double")], ids="-".join)
def pair(request, tmp_path_factory):
    name, precision = request.param
    law = LAWS[name](precision)
    return law, Compiled(law, render(law, laws.PROVENANCE), tmp_path_factory.mktemp(name)), ReferenceStep(law)


def reference(step: ReferenceStep, m, state):
    """The reference step on the memory layout of the C: controller states, then held outputs (or the unused member)."""
    n = len(step.law.states)
    holds = step.law.fallback is Fallback.LAST_OUTPUT
    xi, u, status = step(m, state[:, :n], state[:, n:] if holds else None)
    rest = u if holds else state[:, n:]
    return np.hstack([xi, rest]), u, status


def ulps(dtype, a, b):
    """Difference in units of the last place of numbers of order one or of b."""
    a, b = a.astype(np.float64), b.astype(np.float64)
    return np.max(np.abs(a - b) / (np.finfo(dtype).eps * np.maximum(np.abs(b), 1.0)), initial=0.0)


def tolerance(law) -> int:
    """In ulps: cos and tanh of two libraries differ by a few; gains and the condition of a block amplify that."""
    return 128 if any(isinstance(solve, VectorSolve) for solve in law.solves) else 8


def test_c_agrees_with_the_reference_step(pair):
    law, compiled, step = pair
    rng = np.random.default_rng(20260101)
    count = 4000
    scale = 10.0 ** rng.uniform(-6, 3, (count, 1))
    m = (scale * rng.normal(size=(count, len(law.inputs)))).astype(compiled.dtype)
    state = np.tile(compiled.initial_state(), (count, 1))
    state[:, : len(law.states)] = rng.normal(size=(count, len(law.states)))
    following, u, status = compiled.step(m, state)
    expected_following, expected_u, expected_status = reference(step, m, state)
    assert (status == StepStatus.OK).all()
    assert (expected_status == StepStatus.OK).all()
    assert ulps(compiled.dtype, u, expected_u) <= tolerance(law)
    assert ulps(compiled.dtype, following, expected_following) <= tolerance(law)


def test_a_trajectory_stays_together(pair):
    law, compiled, step = pair
    state_c = state_py = compiled.initial_state()[None, :]
    rng = np.random.default_rng(7)
    for _ in range(300):
        m = rng.normal(size=(1, len(law.inputs))).astype(compiled.dtype)
        state_c, u_c, _ = compiled.step(m, state_c)
        state_py, u_py, _ = reference(step, m, state_py)
        assert ulps(compiled.dtype, u_c, u_py) <= 2 * tolerance(law)
        assert ulps(compiled.dtype, state_c, state_py) <= 2 * tolerance(law)


def specials(dtype):
    limits = np.finfo(dtype)
    magnitudes = [0.0, limits.smallest_subnormal, limits.tiny, 1.0, 1e15, 2.0**63, 1e30, limits.max, np.inf]
    return np.array([np.nan, *magnitudes, *(-value for value in magnitudes)], dtype)


def test_every_special_value_keeps_the_output_in_its_interval_and_the_state_finite(pair):
    law, compiled, step = pair
    values = specials(compiled.dtype)
    nm, ns = len(law.inputs), compiled.sizes[0]
    corners = [list(c) for c in itertools.product(range(len(values)), repeat=2)]
    rng = np.random.default_rng(3)
    rows = np.array([[c[k % 2] for k in range(nm + ns)] for c in corners])
    rows = np.vstack([rows, rng.integers(len(values), size=(3000, nm + ns))])
    m, state = values[rows[:, :nm]], values[rows[:, nm:]]
    following, u, status = compiled.step(m, state)
    bounds = [(float(lo), float(hi)) for lo, hi in law.intervals]
    assert all((u[:, k] >= lo).all() and (u[:, k] <= hi).all() for k, (lo, hi) in enumerate(bounds))
    used = slice(0, 0 if not law.states and law.fallback is Fallback.EQUILIBRIUM else None)
    assert np.isfinite(following[:, used]).all()
    with np.errstate(all="ignore"):
        usable = sum(column * column for column in m.T) <= compiled.dtype.type(STATE_LIMIT[law.precision] ** 2)
    np.testing.assert_array_equal(status == StepStatus.INVALID_INPUT, ~usable)
    _, expected_u, expected_status = reference(step, m, state)
    unconverged = (status == StepStatus.NOT_CONVERGED) | (expected_status == StepStatus.NOT_CONVERGED)
    ordinary = np.all((np.abs(m) < 1e14) | ~np.isfinite(m), axis=1) & ~unconverged
    assert (status == expected_status)[ordinary].all()
    assert ulps(compiled.dtype, u[ordinary], expected_u[ordinary]) <= 2 * tolerance(law)


def test_random_bit_patterns_keep_the_output_in_its_interval(pair):
    law, compiled, _ = pair
    rng = np.random.default_rng(11)
    count = 5000
    size = compiled.dtype.itemsize
    m = np.frombuffer(rng.bytes(count * len(law.inputs) * size), compiled.dtype).reshape(count, -1)
    state = np.frombuffer(rng.bytes(count * compiled.sizes[0] * size), compiled.dtype).reshape(count, -1)
    following, u, _ = compiled.step(m, state)
    for k, (lo, hi) in enumerate(law.intervals):
        assert (u[:, k] >= float(lo)).all()
        assert (u[:, k] <= float(hi)).all()
    if law.states:
        assert np.isfinite(following).all()


def test_an_invalid_measurement_keeps_the_state_and_falls_back(pair):
    law, compiled, _ = pair
    m = np.full((1, len(law.inputs)), 0.5)
    state, u, _ = compiled.step(m, compiled.initial_state()[None, :])
    m[0, -1] = np.nan
    after, fallback, status = compiled.step(m, state)
    assert status[0] == StepStatus.INVALID_INPUT
    np.testing.assert_array_equal(after, state)
    if law.fallback is Fallback.LAST_OUTPUT:
        np.testing.assert_array_equal(fallback, u)
    else:
        expected = np.clip(law.equilibrium_output, *np.array(law.intervals, float).T)
        np.testing.assert_array_equal(fallback[0], expected.astype(compiled.dtype))


def test_null_pointers_are_reported(pair):
    law, compiled, _ = pair
    for missing in ("state", "input"):
        u, status = compiled.step_null(missing)
        assert status == StepStatus.INVALID_ARGUMENT
        np.testing.assert_allclose(u, law.equilibrium_output)
    assert compiled.step_null("output")[1] == StepStatus.INVALID_ARGUMENT


def test_a_corrupted_state_is_reset_and_reported(tmp_path):
    law = laws.two_channels("float", Fallback.LAST_OUTPUT)
    compiled = Compiled(law, render(law, laws.PROVENANCE), tmp_path)
    good = compiled.initial_state()
    np.testing.assert_array_equal(good, np.array([0, 0, -0.25, 0], np.float32))
    for index, value in [(0, np.nan), (1, -np.inf), (1, 1e19)]:
        state = good.copy()
        state[index] = value
        reset = compiled.step(np.ones((1, 2)), state[None, :])
        fresh = compiled.step(np.ones((1, 2)), good[None, :])
        assert reset[2][0] == StepStatus.STATE_RESET
        np.testing.assert_array_equal(reset[0], fresh[0])
        np.testing.assert_array_equal(reset[1], fresh[1])


def test_a_corrupted_held_output_is_replaced_when_it_is_needed(tmp_path):
    law = laws.two_channels("float", Fallback.LAST_OUTPUT)
    compiled = Compiled(law, render(law, laws.PROVENANCE), tmp_path)
    good = compiled.initial_state()
    for value in (2.3, np.nan, -np.inf):
        state = good.copy()
        state[2] = value
        following, u, status = compiled.step(np.array([[np.nan, 0]]), state[None, :])
        assert status[0] == StepStatus.INVALID_INPUT
        np.testing.assert_array_equal(following[0], good)
        np.testing.assert_array_equal(u[0], good[2:])


def test_the_clamp_lets_nothing_through(tmp_path):
    package = render(laws.stateless("float"), laws.PROVENANCE)
    package.write(tmp_path / "package")
    (tmp_path / "probe.c").write_text(
        '#include "package/stateless.c"\n'
        "float probe(float x);\nfloat probe(float x) { return stateless_clamp(x, -1.0f, 2.0f); }\n"
    )
    run([*compiler(), "-std=c99", "-O2", "-shared", "-fPIC", "probe.c", "-o", "probe.so", "-lm"], cwd=tmp_path)
    ffi = cffi.FFI()
    ffi.cdef("float probe(float x);")
    probe = ffi.dlopen(str(tmp_path / "probe.so")).probe
    inf, tiny = float("inf"), 2.0**-149
    expected = {-inf: -1, inf: 2, -1: -1, 2: 2, 0.5: 0.5, tiny: tiny, 3e38: 2, -1.0000001: -1, float("nan"): -1}
    assert {x: probe(x) for x in expected} == expected


def test_an_unsolved_loop_is_reported_and_stays_bounded(tmp_path):
    law = laws.block("double")
    law = replace(law, solves=(replace(law.solves[0], iterations=1),))
    compiled = Compiled(law, render(law, laws.PROVENANCE), tmp_path)
    m = np.linspace(-9, 9, 30).reshape(10, 3)
    state = np.tile(compiled.initial_state(), (10, 1))
    _, u, status = compiled.step(m, state)
    expected = reference(ReferenceStep(law), m, state)
    assert StepStatus.NOT_CONVERGED in status
    np.testing.assert_array_equal(status, expected[2])
    np.testing.assert_allclose(u, expected[1], rtol=1e-12)
    assert (np.abs(u) <= 2).all()


@pytest.mark.parametrize("precision", ["float", "double"])
def test_without_library_functions_c_and_reference_agree_to_the_last_bit(precision, tmp_path):
    law = laws.constant_channels(precision)
    compiled = Compiled(law, render(law, laws.PROVENANCE), tmp_path)
    rng = np.random.default_rng(5)
    shape = (20_000, len(law.inputs))
    m = (rng.normal(size=shape) * 10 ** rng.uniform(-6, 4, shape)).astype(compiled.dtype)
    state = rng.normal(size=shape).astype(compiled.dtype)
    m[:400] = rng.choice(specials(compiled.dtype), (400, shape[1]))
    state[200:600] = rng.choice(specials(compiled.dtype), (400, shape[1]))
    found, expected = compiled.step(m, state), reference(ReferenceStep(law), m, state)
    for ours, theirs in zip(found, expected, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert {StepStatus.OK, StepStatus.STATE_RESET, StepStatus.INVALID_INPUT} <= {*found[2]}
