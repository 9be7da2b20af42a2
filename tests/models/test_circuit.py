import casadi as ca
import numpy as np
import pytest

from pbcgen import Circuit, Design, DynamicExtension, ModelError, Parameters, check

P = Parameters(L1="0.01", L2="0.02", C="2e-4", r=100, a="1e-7", b="0.25")
X1, X2, X3 = (ca.SX.sym(name) for name in ("x1", "x2", "x3"))
LOAD = P.a * (ca.exp(X3 / P.b) - 1)
RLC = {
    "i_L": [X1, X2],
    "v_C": [X3],
    "L": [P.L1, P.L2],
    "C": [P.C],
    "Gamma": [[1], [-1]],
    "v_R": [0, P.r * X2],
    "i_G": [LOAD],
    "g_L": [-1, 0],
    "parameters": P,
}
POINT = [0.03, -0.02, 2.7]


def _value(expression, system):
    function = ca.Function("e", [system.x, system.parameters.symbols], [ca.densify(expression)])
    return np.array(function(POINT[: system.n], system.parameters.numeric))


@pytest.fixture(scope="module")
def rlc():
    return Circuit(**RLC).lower()


def test_the_rlc_has_the_equations_of_its_meshes(rlc):
    x1, x2, x3 = POINT
    load = 1e-7 * (np.exp(x3 / 0.25) - 1)
    np.testing.assert_allclose(
        _value(rlc.f, rlc).ravel(), [-x3 / 0.01, (x3 - 100 * x2) / 0.02, (x1 - x2 - load) / 2e-4]
    )
    np.testing.assert_allclose(_value(rlc.g, rlc), [[100], [0], [0]])


def test_the_storage_is_p_tilde_with_the_missing_square(rlc):
    """The printed formula lacks the square, has x3 in the place of x2, and i_rD is -i_G."""
    x1, x2, x3 = POINT
    load = 1e-7 * (np.exp(x3 / 0.25) - 1)
    expected = x3**2 / 0.02 + (100 * x2 - x3) ** 2 / 0.04 + (x1 - x2 - load) ** 2 / 4e-4
    np.testing.assert_allclose(_value(rlc.S, rlc), expected)


def test_q_tilde_is_the_printed_one(rlc):
    expected = [[0, 0, 1], [0, -100, -1], [-1, 1, -1e-7 / 0.25 * np.exp(POINT[2] / 0.25)]]
    np.testing.assert_allclose(_value(rlc.circuit.Q_tilde, rlc), expected)
    product = ca.mtimes(ca.mtimes(rlc.circuit.P_hessian, rlc.circuit.Xi), rlc.circuit.Q)
    np.testing.assert_allclose(_value(product, rlc), expected, atol=1e-12)


def test_the_gradient_of_the_storage_is_q_tilde_times_the_drift(rlc):
    assert ca.is_equal(rlc.structure.A, rlc.circuit.Q_tilde)
    gradient = _value(ca.gradient(rlc.S, rlc.x), rlc)
    np.testing.assert_allclose(_value(ca.mtimes(rlc.structure.A, rlc.f), rlc), gradient, rtol=1e-12)


def test_the_passive_output_is_the_derivative_of_x3_over_l1(rlc):
    """y = -g^T Q_tilde^T x', which for the circuit is x3'/L1 whatever u is."""
    y = -ca.mtimes(ca.mtimes(rlc.g.T, rlc.circuit.Q_tilde.T), rlc.f)
    np.testing.assert_allclose(_value(y, rlc), _value(rlc.f[2] / P.L1, rlc))


def test_potentials_may_be_given_instead():
    from_potentials = Circuit(
        **{
            **RLC,
            "v_R": None,
            "i_G": None,
            "P_R": P.r * X2**2 / 2,
            "P_G": P.a * (P.b * ca.exp(X3 / P.b) - X3),
        }
    ).lower()
    given = Circuit(**RLC).lower()
    for left, right in ((from_potentials.f, given.f), (from_potentials.S, given.S)):
        np.testing.assert_allclose(_value(left, given), _value(right, given))
    parts = from_potentials.circuit
    np.testing.assert_allclose(_value(ca.gradient(parts.P, given.x), given), _value(parts.P_gradient, given))
    assert given.circuit.P is None


def test_linear_resistors_have_a_known_potential():
    parts = Circuit(**{**RLC, "i_G": [X3 / P.r]}).parts
    system = Circuit(**RLC).lower()
    np.testing.assert_allclose(_value(ca.gradient(parts.P, system.x), system), _value(parts.P_gradient, system))


def test_both_kinds_of_sources_act_on_their_own_elements():
    system = Circuit(**RLC, g_C=[1], inputs=["voltage", "current"]).lower()
    assert system.input_names == ("voltage", "current")
    np.testing.assert_allclose(_value(system.g, system), [[100, 0], [0, 0], [0, 5000]])


def test_coupled_inductors_and_a_circuit_without_capacitors():
    system = Circuit([X1, X2], [], L=[[2, 1], [1, 2]], C=[], v_R=[X1, X2], g_L=[[-1, 0], [0, -1]]).lower()
    np.testing.assert_allclose(_value(system.f, system).ravel(), -np.linalg.solve([[2, 1], [1, 2]], POINT[:2]))
    assert system.state_names == ("x1", "x2")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"L": [[1, 2], [0, 1]]}, "inductance L is not symmetric"),
        ({"L": [1, 0]}, "inductance L is singular"),
        ({"L": [X1, 1]}, "inductance L depends on the state `x1`"),
        ({"L": [1, 2, 3]}, "inductance L must be 2x2, it is 3x1"),
        ({"C": None}, "capacitance C is missing"),
        ({"C": [float("nan")]}, "capacitance C contains a constant that is not a finite number"),
        ({"Gamma": [1]}, "interconnection Gamma must be 2x1, it is 1x1"),
        ({"Gamma": [X1, 1]}, "interconnection Gamma depends on the state `x1`"),
        ({"v_R": [X1]}, "v_R must be 2x1, it is 1x1"),
        ({"v_R": [X2, 0]}, "v_R is not the gradient of a potential"),
        ({"v_R": [X3, 0]}, "v_R contains the symbol `x3`|v_R depends on the state `x3`"),
        ({"i_G": [X1]}, "i_G .*`x1`"),
        ({"P_G": X3}, "i_G and P_G are both given"),
        ({"g_L": None}, "circuit has no source"),
        ({"g_L": [1]}, "g_L must be 2x1, it is 1x1"),
        ({"g_L": [X1, 0]}, "g_L depends on the state `x1`"),
        ({"inputs": ["a", "b"]}, "`inputs` has 2 names"),
        ({"parameters": None}, "neither a state, an input nor a parameter"),
    ],
)
def test_a_bad_circuit_is_refused_by_name(changes, message):
    with pytest.raises(ModelError, match=message):
        Circuit(**{**RLC, **changes})


def test_numbers_in_the_storage_elements_stay_exact():
    """A ladder with L = 3 and C = 7: neither reciprocal is a decimal."""
    i, v = ca.SX.sym("i"), ca.SX.sym("v")
    circuit = Circuit(i, v, L=[3], C=[7], Gamma=[[1]], v_R=[i], i_G=[2 * v], g_L=[[-1]])
    design = Design(circuit, {"v": 1}, DynamicExtension(1, 1, 1, 1), sample_period="1e-3", name="ladder")
    claims = {claim.claim: claim for claim in check(design).claims}
    assert claims["assumption-1"].status == "PROVED"
    assert claims["passive-output"].status == "PROVED"


def test_an_empty_list_is_the_interconnection_of_a_network_of_one_kind():
    a, b = ca.SX.sym("a"), ca.SX.sym("b")
    system = Circuit([], [a, b], L=[], C=[1, 2], Gamma=[], i_G=[a - b, 2 * b - a], g_C=[1, 0]).lower()
    assert (system.n, system.m) == (2, 1)


def test_an_empty_list_is_no_interconnection_of_both_kinds():
    i, v = ca.SX.sym("i"), ca.SX.sym("v")
    with pytest.raises(ModelError, match="Gamma must be 1x1, it is 0x1"):
        Circuit([i], [v], L=[1], C=[1], Gamma=[], v_R=[i], i_G=[v], g_L=[-1])
