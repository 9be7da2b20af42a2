import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pbcgen import Design, DynamicExtension, Mechanical, ModelError, Parameters, check
from pbcgen.models.inertia import independent_blocks, inverse, solve

P = Parameters(m1=2, m2="1.5", l1=1, l2="0.8", g="9.81", d="0.1")
Q, V = [ca.SX.sym("q1"), ca.SX.sym("q2")], [ca.SX.sym("v1"), ca.SX.sym("v2")]


def _energies():
    """A double pendulum of point masses, from the positions of the masses."""
    q, v = ca.vertcat(*Q), ca.vertcat(*V)
    elbow = P.l1 * ca.vertcat(ca.sin(q[0]), -ca.cos(q[0]))
    tip = elbow + P.l2 * ca.vertcat(ca.sin(q[0] + q[1]), -ca.cos(q[0] + q[1]))
    speeds = [ca.mtimes(ca.jacobian(point, q), v) for point in (elbow, tip)]
    T = P.m1 * ca.sumsqr(speeds[0]) / 2 + P.m2 * ca.sumsqr(speeds[1]) / 2
    return T, P.g * (P.m1 * elbow[1] + P.m2 * tip[1])


@pytest.fixture(scope="module")
def arm():
    T, potential = _energies()
    return Mechanical.from_lagrangian(Q, V, T=T, V=potential, G=[1, 0], D=[P.d, P.d * V[1] ** 2], parameters=P)


ANGLE = st.floats(-3, 3)


@settings(deadline=None, max_examples=30)
@given(q=st.tuples(ANGLE, ANGLE), v=st.tuples(ANGLE, ANGLE), u=ANGLE)
def test_the_hamiltonian_flow_is_that_of_the_differentiated_lagrangian(arm, q, v, u):
    """d/dt grad_v L - grad_q L = G u - D v, every derivative of L by central differences."""
    T, potential = _energies()
    lagrangian = ca.Function("L", [ca.vertcat(*Q), ca.vertcat(*V), P.symbols], [T - potential])

    def L(position, speed):
        return float(lagrangian(position, speed, P.numeric))

    step = 1e-4
    unit = np.eye(2) * step
    q, v = np.array(q), np.array(v)
    force = np.array([(L(q + e, v) - L(q - e, v)) / (2 * step) for e in unit])

    def momentum(position, speed):
        return np.array([(L(position, speed + e) - L(position, speed - e)) / (2 * step) for e in unit])

    inertia = np.column_stack([(momentum(q, v + e) - momentum(q, v - e)) / (2 * step) for e in unit])
    expected_pdot = force + np.array([u, 0]) - np.array([0.1, 0.1 * v[1] ** 2]) * v

    system = arm.lower()
    xdot = ca.Function("xdot", [system.x, system.u, P.symbols], [system.xdot])
    state = np.concatenate([q, inertia @ v])
    np.testing.assert_allclose(np.array(xdot(state, u, P.numeric)).ravel()[:2], v, atol=1e-4)
    np.testing.assert_allclose(np.array(xdot(state, u, P.numeric)).ravel()[2:], expected_pdot, atol=2e-3)


def _same(first, second, tolerance=1e-10):
    for left, right in ((first.f, second.f), (first.g, second.g), (first.S, second.S)):
        values = [
            np.array(ca.Function("e", [s.x, s.parameters.symbols], [e])([0.3, -0.7, 1.1, 0.4], s.parameters.numeric))
            for s, e in ((first, left), (second, right))
        ]
        np.testing.assert_allclose(*values, atol=tolerance)


def test_from_lagrangian_equals_the_direct_form(arm):
    T, potential = _energies()
    p = [ca.SX.sym("p1"), ca.SX.sym("p2")]
    M = ca.hessian(T, ca.vertcat(*V))[0]
    speed = ca.mtimes(inverse(M), ca.vertcat(*p))[1]
    direct = Mechanical(Q, p, M=M, V=potential, G=[1, 0], D=[P.d, P.d * speed**2], parameters=P)
    assert arm.lower().state_names == ("q1", "q2", "p_q1", "p_q2")
    _same(arm.lower(), direct.lower())


def test_the_inverse_inertia_may_be_given_instead(arm):
    p, parts = arm.p, arm.parts
    from_inverse = Mechanical(arm.q, p, M_inv=inverse(parts.M), V=parts.V, G=parts.G, D=parts.D, parameters=P)
    both = Mechanical(arm.q, p, M=parts.M, M_inv=parts.M_inv, V=parts.V, G=parts.G, D=parts.D, parameters=P)
    _same(arm.lower(), from_inverse.lower())
    _same(arm.lower(), both.lower())


def test_the_drift_is_f_times_the_gradient_of_the_storage(arm):
    system = arm.lower()
    difference = system.f - ca.mtimes(system.structure.F, ca.gradient(system.S, system.x))
    value = ca.Function("d", [system.x, P.symbols], [difference])([0.2, 0.9, -1, 2], P.numeric)
    np.testing.assert_allclose(np.array(value), 0, atol=1e-12)
    assert system.measured_names == ("q1", "q2")
    assert system.mechanical is arm.parts


def test_no_inverse_is_differentiated(arm):
    """The drift takes about as many operations as the forces of a hand-written arm."""
    system = arm.lower()
    direct = ca.mtimes(system.structure.F, ca.gradient(system.S, system.x))
    ours, differentiated = (
        ca.Function("f", [system.x, P.symbols], [ca.cse(e)]).n_instructions() for e in (system.f, direct)
    )
    assert ours < differentiated


def test_input_matrices_may_depend_on_the_position_and_have_any_place():
    q, p = ca.SX.sym("q", 2), ca.SX.sym("p", 2)
    system = Mechanical(q, p, M=[1, 2], V=0, G=ca.vertcat(ca.cos(q[1]), 1), inputs="F").lower()
    assert system.input_names == ("F",)
    assert ca.is_equal(system.g, ca.vertcat(0, 0, ca.cos(q[1]), 1), 3)


@pytest.mark.parametrize("n", [1, 2, 3, 4, 6])
def test_the_symbolic_inverse_is_the_inverse(n):
    root = np.random.default_rng(n).normal(size=(n, n))
    M = root @ root.T + np.eye(n)
    symbolic = ca.SX.sym("M", n, n)
    right = np.arange(2.0 * n).reshape(n, 2)
    function = ca.Function("f", [symbolic], [inverse(symbolic), solve(symbolic, ca.SX(right))])
    np.testing.assert_allclose(np.array(function(M)[0]), np.linalg.inv(M), atol=1e-10)
    np.testing.assert_allclose(np.array(function(M)[1]), np.linalg.solve(M, right), atol=1e-10)


def test_a_sparse_inertia_is_inverted_by_blocks():
    a, b, c, d = (ca.SX.sym(name) for name in "abcd")
    M = ca.blockcat([[a, 0, b], [0, d, 0], [b, 0, c]])
    assert independent_blocks(M) == [[0, 2], [1]]
    assert inverse(M).nnz() == 5


q2, p2 = ca.SX.sym("q", 2), ca.SX.sym("p", 2)
GOOD = {"M": [1, 2], "V": ca.cos(q2[0]), "G": [0, 1]}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"M": [[1, 2], [0, 3]]}, "inertia matrix M is not symmetric"),
        ({"M": [[1, q2[0]], [ca.sin(q2[0]), 3]]}, "inertia matrix M is not symmetric"),
        ({"M": [1, 0]}, "inertia matrix M is singular"),
        ({"M": [1, 2, 3]}, "inertia matrix M must be 2x2, it is 3x1"),
        ({"M": [1, p2[0]]}, "inertia matrix M depends on the momentum `p_0`"),
        ({"M": None}, "inertia is missing"),
        ({"M_inv": [1, 1]}, "M and M_inv are not inverse"),
        ({"D": [[1, 1], [0, 1]]}, "D is not symmetric"),
        ({"D": [1]}, "damping D must be 2x2, it is 1x1"),
        ({"V": p2[0]}, "potential energy V depends on the momentum `p_0`"),
        ({"V": q2}, "potential energy V must be 1x1, it is 2x1"),
        ({"V": None}, "potential energy V is missing"),
        ({"V": ca.SX.sym("y")}, "potential energy V contains the symbol `y`"),
        ({"G": [1, 2, 3]}, "input matrix G must be 2x1, it is 3x1"),
        ({"G": ca.mtimes(p2, 1)}, "input matrix G depends on the momentum"),
        ({"inputs": ["a", "b"]}, "`inputs` has 2 names, the input matrix has 1 columns"),
        ({"M": [float("nan"), 1]}, r"entry \(1, 1\) of the inertia matrix M"),
    ],
)
def test_a_bad_mechanical_system_is_refused_by_name(changes, message):
    with pytest.raises(ModelError, match=message):
        Mechanical(q2, p2, **{**GOOD, **changes})


def test_momenta_pair_with_positions():
    with pytest.raises(ModelError, match="2 positions q and 1 momenta p"):
        Mechanical(q2, p2[0], **GOOD)


@pytest.mark.parametrize(
    ("T", "message"),
    [
        (V[0] ** 4 + V[1] ** 2, "not quadratic in the velocities"),
        (V[0] ** 2 + V[1] ** 2 + Q[0] * V[0], "linear in the velocities"),
        (V[0] ** 2 + V[1] ** 2 + Q[0] ** 2, "does not vanish at rest"),
        (V[0] ** 2, "inertia matrix M is singular"),
    ],
)
def test_a_kinetic_energy_that_is_no_quadratic_form_is_refused(T, message):
    with pytest.raises(ModelError, match=message):
        Mechanical.from_lagrangian(Q, V, T=T, V=0, G=[0, 1])


def test_names_of_momenta_are_counted():
    with pytest.raises(ModelError, match="1 names of momenta"):
        Mechanical.from_lagrangian(Q, V, T=V[0] ** 2 + V[1] ** 2, V=0, G=[0, 1], momenta=["p1"])


@pytest.mark.parametrize("M", [[[1, 0], [0, 3]], [["1.5", 0.25], [0.25, 7]], [[1, 0.5], [0.5, 1]]])
def test_numbers_in_the_inertia_stay_exact(M):
    """CasADi would round 1/3; the storage of an undamped chain must still be proved not to grow."""
    M = [[float(entry) for entry in row] for row in M]
    q, p = ca.SX.sym("q", 2), ca.SX.sym("p", 2)
    system = Mechanical(q, p, M=M, V=(q[0] - q[1]) ** 2 / 2, G=[[1], [0]], D=[0, 0])
    design = Design(system, {"q_0": 0}, DynamicExtension(1, 1, 1, 1), sample_period="1e-3", name="chain")
    claims = {claim.claim: claim for claim in check(design).claims}
    assert claims["assumption-1"].status == "PROVED"
    assert claims["passive-output"].status == "PROVED"


def test_the_weights_of_an_inertia_by_factors_are_diagonals_where_they_are_lists():
    q, p = ca.SX.sym("q", 2), ca.SX.sym("p", 2)
    lever = ca.vertcat(ca.horzcat(ca.cos(q[0]), 0), ca.horzcat(1, 1))
    given = ([P.m1, P.m2], ca.diag(ca.vertcat(P.m1, P.m2)))
    first, second = (Mechanical(q, p, M=[(lever, W), (np.eye(2), 1)], V=0, G=[1, 0], parameters=P) for W in given)
    difference = ca.Function("d", [q, p, P.symbols], [first.system.S - second.system.S])
    assert abs(float(difference([0.3, 0.7], [0.2, -0.5], [2, 1.5, 1, 0.8, 9.81, 0.1]))) < 1e-12
    with pytest.raises(ModelError, match="the weight W_1 of M must be 2x2, it is 3x1"):
        Mechanical(q, p, M=[(lever, [1, 2, 3]), (np.eye(2), 1)], V=0, G=[1, 0], parameters=P)


@pytest.mark.parametrize(
    ("damping", "statuses"),
    [
        ([[3, -1], [-1, 1]], ("PROVED", "PROVED")),
        ([[0.5, -0.5], [-0.5, 0.5]], ("PROVED", "PROVED")),  # between the masses only
        ([[1, 2], [2, 1]], ("REFUTED", "REFUTED")),
    ],
)
def test_damping_between_two_masses(damping, statuses):
    q, p = ca.SX.sym("q", 2), ca.SX.sym("p", 2)
    V = q[0] ** 2 / 2 + (q[0] - q[1]) ** 2 + (q[0] - q[1]) ** 4
    system = Mechanical(q, p, M=[2, 1], V=V, D=damping, G=[1, 0])
    report = check(Design(system, {"q_1": "0.3"}, DynamicExtension(2, 3, 5, 1), sample_period="1e-3"))
    found = {c.claim: str(c.status) for c in report.claims}
    assert (found["assumption-1"], found["globally-asymptotically-stable"]) == statuses
