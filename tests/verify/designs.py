"""Designs of many kinds, for certificates of many kinds."""

from __future__ import annotations

import casadi as ca

from pbcgen import (
    AffineSystem,
    Circuit,
    Design,
    DynamicExtension,
    Integral,
    Limits,
    Mechanical,
    NaturalDamping,
    Parameters,
    PassiveOutput,
    PotentialCompensation,
    load,
)

LAW = DynamicExtension(2, 3, 5, 1)


def _symbols(*names):
    return [ca.SX.sym(name) for name in names]


def _design(system, target, law=LAW, **options):
    return Design(system, target, law, **{"sample_period": "1e-3", "name": "trial", **options})


def _one(V, D=1, M=1, **options):
    q, p = _symbols("q", "p")
    return Mechanical([q], [p], M=[[M]], V=V(q), D=[D], G=[[1]], **options)


def _two(V, D, G=((1,), (0,))):
    q1, q2, p1, p2 = _symbols("q1", "q2", "p1", "p2")
    return Mechanical([q1, q2], [p1, p2], M=ca.SX.eye(2), V=V(q1, q2), G=list(G), D=D(p1, p2))


def _three(masses, damping):
    q, p = ca.SX.sym("q", 3), ca.SX.sym("p", 3)
    V = (q[0] - q[1]) ** 2 / 2 + (q[2] - q[1]) ** 2 / 2
    return Mechanical(q, p, M=ca.diag(ca.SX(masses)), V=V, G=[[0], [1], [0]], D=damping)


def _planar(f, S, **options):
    x, y = _symbols("x0", "x1")
    return AffineSystem([x, y], [ca.SX.sym("u")], f(x, y), [0, 1], S(x, y), **options)


def _round(x, y):
    return (x**2 + y**2) / 2


def rest_at_zero_by_newton():
    """Two states rest at zero, which Newton's method finds as 1e-102 give or take 1e-99."""
    x, u = ca.SX.sym("x", 3), ca.SX.sym("u")
    S = 0.75 * x[0] ** 2 + 0.9 * x[1] ** 2 - 1.8 * ca.cos(2 * x[1]) + 2.5 * (ca.exp(x[2]) - x[2])
    e = ca.gradient(S + 0.1 * (x[2] - x[1]) ** 2, x)
    f = [e[2], -1.3 * (1 + 0.5 * ca.tanh(x[1])) * e[1], -e[0] - 0.8 * (1 + 0.5 * ca.tanh(x[2])) * e[2]]
    return _design(AffineSystem(x, [u], f, [0, 0, 1], S + 0.1 * (x[2] - x[1]) ** 2), {"x_0": "0.1"})


def hardening_spring():
    return _design(_one(lambda q: q**2 / 2 + q**4 / 4), {"q": "0.5"})


def softening_spring():
    return _design(_one(lambda q: q**2 / 2 - q**4 / 40), {"q": 0})


def weakly_held_pendulum():
    return _design(_one(lambda q: 10 * (1 - ca.cos(q))), {"q": 0})


def overloaded_pendulum():
    """kappa = -10 sin(0.5) exceeds the amplitude, and the potential does not grow: there are rests one turn away."""
    return _design(_one(lambda q: 10 * (1 - ca.cos(q))), {"q": "0.5"}, DynamicExtension(2, 3, 50, 1))


def compensated_pendulum():
    return _design(_one(lambda q: 10 * (1 - ca.cos(q))), {"q": "0.5"}, PotentialCompensation(20, 3, 50, 1))


def cubic_damping():
    return _design(_two(lambda a, b: a**2 / 2 + b**2 / 2 + a * b / 2, lambda a, b: [0, b**2]), {"q1": "0.5"})


def uncoupled_cubic_damping():
    return _design(_two(lambda a, b: a**2 / 2 + b**2 / 2, lambda a, b: [0, b**2]), {"q1": "0.5"})


def undamped_mode():
    return _design(_two(lambda a, b: a**2 / 2 + b**2 / 2, lambda a, b: [0, 0]), {"q1": "0.5"})


def antisymmetric_mode():
    return _design(_three([1, 1, 1], [0, 0, 0]), {"q_1": "0.5"})


def damped_modes():
    return _design(_three([1, 1, 1], [1, 0, 1]), {"q_1": "0.5"})


def conserved_charge():
    x1, x2, u = _symbols("x1", "x2", "u")
    return _design(AffineSystem([x1, x2], [u], [-(x1 - x2), x1 - x2], [1, -1], x1**2 / 2 + x2**2 / 2), [0, 0])


def buck_converter(law=None):
    i, v, u = _symbols("i", "v", "d")
    system = AffineSystem(
        [i, v], [u], [-v / 0.5, (i - v / 3) / 0.2], [20, 0], 0.25 * i**2 + 0.1 * v**2, measured=["i", "v"]
    )
    return _design(system, {"v": 5}, law or DynamicExtension("0.4", 1, 5, 1), limits=Limits([(0, 1)]))


def buck_converter_full():
    return buck_converter(PassiveOutput("0.2", 1, "0.1"))


def filter_with_load():
    """A linear circuit: its storage is a quadratic form of all states."""
    p = Parameters(L="1e-3", C="1e-4", r="0.5", R=20)
    i, v = _symbols("i", "v")
    circuit = Circuit([i], [v], L=[p.L], C=[p.C], Gamma=[[1]], v_R=[p.r * i], i_G=[v / p.R], g_L=[-1], parameters=p)
    return _design(circuit, {"v": 5}, DynamicExtension(2, "0.001", 1, 100), sample_period="5e-5")


def constant_load():
    return _design(_one(lambda q: 1.5 * q), {"q": 0}, DynamicExtension(1, 3, 5, 1))


def coupling_device_with_theta():
    law = NaturalDamping("2.5", 450, 10**6, "0.3", alpha_l="2.5", beta_l=2 * 10**6, K_l=15, R_l=33)
    return load("coupling_device").with_(law=law)


def damping_on_a_box():
    """Damped where abs(x0) <= 1 only: on the edge of the box the damping vanishes."""
    system = _planar(lambda x, y: [y, -x - (1 - x**2) * y], _round, domain={"x0": (-1, 1)})
    return _design(system, [0, 0])


def narrow_band():
    """The damping almost vanishes in a narrow band: nothing but branch and bound shows that it does not."""
    step = lambda y: ca.tanh((y - 2) / 0.2 + 1) - ca.tanh((y - 2) / 0.2 - 1)  # noqa: E731
    system = _planar(
        lambda x, y: [y, -x - (1.6 - step(y + x / 10)) * y],
        _round,
        domain={"x0": (-5, 5), "x1": (-5, 5)},
    )
    return _design(system, [0, 0])


def quartic_dissipation():
    """Nonnegative as a sum of squares that semidefinite programming finds."""
    return _design(_planar(lambda x, y: [y - (2 * x**3 + 2 * x**2 * y), -x + x**2 * y - 5 * y**3], _round), [0, 0])


def negative_damping():
    return _design(_one(lambda q: q**2 / 2, D=-1), {"q": 0})


def unassignable_target():
    return _design(_two(lambda a, b: a**2 / 2 + b**2, lambda a, b: [1, 1]), {"q1": 1, "q2": 1, "p1": 0, "p2": 0})


def wrong_output():
    """A gamma of the wrong sign that comes with the model."""
    x, y = _symbols("x0", "x1")
    system = AffineSystem([x, y], [ca.SX.sym("u")], [y, -x - y], [0, 1], (x**2 + y**2) / 2, gamma=[-x])
    return _design(system, [0, 0])


def chain(masses=12, law=LAW, sample_period="1e-2", cut=None, last=1, **options):
    """A chain of masses: more states than Routh's array is used for.

    Those behind a ``cut`` have no damping; ``last`` is the damping of the last one.
    """
    q, p = ca.SX.sym("q", masses), ca.SX.sym("p", masses)
    V = sum(((q[k] - (0 if k == cut else q[k + 1])) ** 2 for k in range(masses - 1)), q[0] ** 2) / 2
    G = [[1]] + [[0]] * (masses - 1)
    D = [*(1 if cut is None or k <= cut else 0 for k in range(masses - 1)), last if cut is None else 0]
    system = Mechanical(q, p, M=ca.SX.eye(masses), V=V + (q[masses - 1] ** 2 if cut else 0), G=G, D=D, **options)
    return _design(system, {"q_0": "0.5"}, law, sample_period=sample_period)


def integral_chain():
    """The same with a law that has no Lyapunov function."""
    return chain(law=Integral(LAW, alpha_psi=["0.1"], beta_psi=[1], R_psi=[1]))


def slowly_sampled_chain():
    """The same, sampled more slowly than the storage allows."""
    return chain(sample_period="0.5")


def too_slowly_sampled_chain():
    """The same, sampled so slowly that it is unstable."""
    return chain(sample_period="3")


def pushed_chain():
    """The same with a mass that is pushed on: unstable."""
    return chain(last=-3)


def chain_on_a_domain():
    """The same where nothing is known outside of a box: what the storage shows is local."""
    return chain(domain={"q_0": (-1, 1)})


def cut_chain():
    """The same with half of it on its own, without damping."""
    return chain(cut=5)


def two_links(side=0):
    """A planar arm with two joints, gravity compensated; ``side`` puts the centre of the first link beside it."""
    q, p = ca.SX.sym("q", 2), ca.SX.sym("p", 2)
    c = ca.cos(q[1])
    M = ca.blockcat([[3 + 2 * c, 1 + c], [1 + c, ca.SX(1)]])
    V = 10 * ca.sin(q[0]) + side * ca.cos(q[0]) + 5 * ca.sin(q[0] + q[1])
    law = PotentialCompensation([20, 10], [3, 3], [50, 50], [1, 1])
    system = Mechanical(q, p, M=M, V=V, G=ca.SX.eye(2), D=[1, 1])
    return _design(system, {"q_0": "0.5", "q_1": "0.25"}, law)


def planar_arm(links, law=None, factors=True, **changes):
    """A planar arm whose M^-1 is too large to be written out from three links on; ``changes`` break its formulas.

    velocity: a factor of M^-1 p. coupling: of the Coriolis forces. energy: of the kinetic energy. friction: of joint 1.
    """
    q, p = ca.SX.sym("q", links), ca.SX.sym("p", links)
    angle, at, M, V = 0, ca.SX.zeros(2), 0.1 * ca.SX.eye(links), 0
    for k in range(links):
        angle = angle + q[k]
        at = at + ca.vertcat(ca.cos(angle), ca.sin(angle)) / 2
        J = ca.jacobian(at, q)
        M, V = M + ca.mtimes(J.T, J), V + 2 * at[1]
    pairs = [(ca.SX.eye(links), 0.1)] if factors else []
    if factors:
        angle, at = 0, ca.SX.zeros(2)
        for k in range(links):
            angle = angle + q[k]
            at = at + ca.vertcat(ca.cos(angle), ca.sin(angle)) / 2
            pairs.append((ca.jacobian(at, q), 1))
    D = [1 + 0.25 * ca.tanh(p[0]) ** 2, *[1] * (links - 1)]
    arm = Mechanical(q, p, M=pairs if factors else M, V=V, G=ca.SX.eye(links), D=D)
    law = law or DynamicExtension([20] * links, [3] * links, [50] * links, [1] * links)
    return _design(_broken(arm, **changes) if changes else arm, {f"q_{k}": "0.25" for k in range(links)}, law)


def _broken(arm, velocity=1, coupling=1, energy=1, friction=1):
    """The system with other formulas, and with the parts of the right one beside them."""
    parts, system = arm.parts, arm.system
    n = parts.q.numel()
    f_q, f_p = system.f[:n], system.f[n:]
    rest = ca.substitute(f_p, parts.p, ca.SX.zeros(n))
    drag = ca.mtimes(parts.D, parts.velocity)
    f_p = rest - friction * drag + coupling * (f_p - rest + drag)
    S = energy * (system.S - parts.V) + parts.V
    return AffineSystem(
        system.x,
        system.u,
        ca.vertcat(velocity * f_q, f_p),
        system.g,
        S,
        parameters=system.parameters,
        measured=[s.name() for s in ca.vertsplit(parts.q)],
        gamma=parts.q,
        structure=system.structure,
    )


def three_links():
    return planar_arm(3, factors=False)


def three_links_compensated():
    """Radially unbounded by the squares of its kinetic energy."""
    return planar_arm(3, PotentialCompensation([20] * 3, [3] * 3, [50] * 3, [1] * 3))


def five_links():
    return planar_arm(5)


def cubic_load(load=lambda v: v / 20 + v**3 / 500):
    """A circuit whose currents grow with its state, faster than any form: nothing but their slopes fixes the rest."""
    p = Parameters(L="1e-3", C="1e-4", r="0.5")
    i, v = _symbols("i", "v")
    circuit = Circuit([i], [v], L=[p.L], C=[p.C], Gamma=[[1]], v_R=[p.r * i], i_G=[load(v)], g_L=[-1], parameters=p)
    return _design(circuit, {"v": 5}, DynamicExtension(2, "0.001", 1, 100), sample_period="2e-5")


def tunnel_diode():
    return cubic_load(lambda v: v**3 / 3 - 2 * v**2 + 3.2 * v)


def shunt():
    """``11/10 - tanh(v)^2`` is the conductance of the load."""
    return cubic_load(lambda v: v / 10 + ca.tanh(v))


def quartic_coupling():
    """A potential that grows by a sum of squares."""
    return _design(_two(lambda a, b: (a - b) ** 4 / 4 + (a - b) ** 2 / 2, lambda a, b: [0, b**2]), {"q1": 1})


def balanced_link():
    """Gravity behind a spring: all rests lie in a box of the motor's angle and the torque."""
    return load("elastic_pendulum")


def stiff_pendulum(gravity=2, law=None):
    return _design(_one(lambda q: gravity * (1 - ca.cos(q))), {"q": "0.4"}, law or DynamicExtension(30, 2, 50, 1))


def heavy_pendulum():
    """With so much gravity it hangs at other angles, too."""
    return stiff_pendulum(40, DynamicExtension(30, 2, 50, 1))


def double_well():
    """The quartic term makes the storage grow, the stiff law leaves one rest."""
    return _design(_one(lambda q: q**4 / 4 - q**2 / 2), {"q": "1.5"}, DynamicExtension(30, 2, 50, 1))


def diode(load=lambda v: ca.exp(v) - 1):
    """A circuit whose load has no least slope: only together its currents grow with its state."""
    return cubic_load(lambda v: v / 100 + load(v) / 50)


def plain_diode():
    i, v = _symbols("i", "v")
    circuit = Circuit([i], [v], L=[1], C=[1], Gamma=[[1]], v_R=[i], i_G=[ca.exp(v) - 1], g_L=[-1])
    return _design(circuit, {"v": "0.5"}, near={"i": 1})


def falling_diode():
    """The same with a characteristic that falls somewhere."""
    i, v = _symbols("i", "v")
    circuit = Circuit([i], [v], L=[1], C=[1], Gamma=[[1]], v_R=[i], i_G=[3 * v**3 - v], g_L=[-1])
    return _design(circuit, {"v": "0.5"}, near={"i": 1})


def one_sided_spring():
    """A storage that grows because it is convex and x* its strict minimum: u* exceeds the amplitude."""
    return _design(_one(ca.exp), {"q": 1})


def softened_spring():
    return _design(_one(lambda q: ca.exp(q) - 2 * q**2), {"q": 0})


def seen_mode(V=lambda a, b: a**2 + b**2 + a * b**2 / 3 + b**4 / 4):
    """On the invariant set a product vanishes: each of its factors stops the second mass."""
    return _design(_two(V, lambda a, b: [0, 0]), {"q1": 0}, near={"q2": 0})


def unseen_mode():
    return seen_mode(lambda a, b: a**2 + b**2 + b**4 / 4)


def smoothly_loaded():
    """A potential that a logarithm of what is positive makes smooth everywhere."""
    V = lambda q: 20 * ca.log(ca.cosh(q / 20)) - ca.cos(q)  # noqa: E731
    return _design(_one(V), {"q": 0}, PotentialCompensation(1, 1, 1, 1))


def spring_on_a_domain():
    """The compensated force is bounded on the domain only."""
    law = PotentialCompensation(2, 1, 1, 1)
    return _design(_one(lambda q: 3 * q**2 / 2, domain={"q": (-1, 1)}), {"q": "0.5"}, law, limits=Limits.symmetric(5))


def weakly_damped(friction=lambda b, v: (b - 1.7) ** 2):
    """Natural damping by a friction that vanishes somewhere."""
    q1, q2, p1, p2 = _symbols("q1", "q2", "p1", "p2")
    V = q1**2 + q2**2 + (q1 - q2) ** 2
    system = Mechanical([q1, q2], [p1, p2], M=[1, 2], V=V, D=[1, friction(q2, p2)], G=[1, 0], eta=[q2])
    law = NaturalDamping(1, 1, 1, 1, alpha_l=1, beta_l=1, K_l=5, R_l=5)
    return _design(system, {"q1": 0, "q2": 0}, law)


def partly_negative_damping():
    return weakly_damped(lambda b, v: b)


DESIGNS = {
    f.__name__: f
    for f in (
        rest_at_zero_by_newton,
        hardening_spring,
        softening_spring,
        weakly_held_pendulum,
        overloaded_pendulum,
        compensated_pendulum,
        cubic_damping,
        uncoupled_cubic_damping,
        undamped_mode,
        antisymmetric_mode,
        damped_modes,
        conserved_charge,
        buck_converter,
        buck_converter_full,
        filter_with_load,
        constant_load,
        coupling_device_with_theta,
        damping_on_a_box,
        narrow_band,
        quartic_dissipation,
        negative_damping,
        unassignable_target,
        wrong_output,
        chain,
        integral_chain,
        slowly_sampled_chain,
        too_slowly_sampled_chain,
        pushed_chain,
        chain_on_a_domain,
        cut_chain,
        two_links,
        three_links,
        three_links_compensated,
        five_links,
        cubic_load,
        tunnel_diode,
        shunt,
        quartic_coupling,
        balanced_link,
        stiff_pendulum,
        heavy_pendulum,
        double_well,
        diode,
        plain_diode,
        falling_diode,
        one_sided_spring,
        softened_spring,
        seen_mode,
        unseen_mode,
        smoothly_loaded,
        spring_on_a_domain,
        weakly_damped,
        partly_negative_damping,
    )
}
