"""The model as formulas, the way it was written down."""

from __future__ import annotations

from collections.abc import Iterator

import casadi as ca

from pbcgen.passivity.plant import Plant
from pbcgen.report.mathematics import Formula, entry, expressions, rate, symbols, written_matrix


def model_formulas(plant: Plant) -> list[Formula]:
    """The system as it was written down."""
    system = plant.system
    if system.mechanical is not None:
        return list(_mechanical(plant))
    if system.circuit is not None:
        return list(_circuit(plant))
    return list(_affine(plant))


def _rates(plant: Plant) -> str:
    rows = [
        f"{rate(name)} &= {row[0]}"
        for name, row in zip(plant.system.state_names, expressions(plant, plant.system.xdot), strict=True)
    ]
    return r"\begin{aligned}" + r" \\ ".join(rows) + r"\end{aligned}"


def _affine(plant: Plant) -> Iterator[Formula]:
    yield Formula("Dynamics x' = f(x) + g(x) u (afsys)", _rates(plant))
    yield Formula("Storage function", f"S(x) = {entry(plant, plant.system.S)}")


def _mechanical(plant: Plant) -> Iterator[Formula]:
    parts = plant.system.mechanical
    assert parts is not None
    q, p = ([e.name() for e in ca.vertsplit(s)] for s in (parts.q, parts.p))
    yield Formula(
        "Dynamics in port-Hamiltonian form (phmec)",
        r"\begin{bmatrix} \dot q \\ \dot p \end{bmatrix} = \begin{bmatrix} 0 & I \\ -I & -D \end{bmatrix} "
        r"\begin{bmatrix} \nabla_q H \\ \nabla_p H \end{bmatrix} + \begin{bmatrix} 0 \\ G \end{bmatrix} u, \quad "
        rf"q = {symbols(q)}, \quad p = {symbols(p)}, \quad u = {symbols(plant.system.input_names)}",
    )
    yield Formula(
        "Storage function: the energy",
        r"S(x) = H(q, p) = \tfrac{1}{2} p^{\top} M(q)^{-1} p + V(q), \quad \dot q = M^{-1} p",
    )
    yield Formula("Inertia matrix", f"M(q) = {written_matrix(plant, parts.M)}")
    yield Formula("Potential energy", f"V(q) = {entry(plant, parts.V)}")
    yield Formula(
        "Damping and input matrices",
        f"D = {written_matrix(plant, parts.D)}, \\quad G = {written_matrix(plant, parts.G)}",
    )


def _circuit(plant: Plant) -> Iterator[Formula]:
    parts = plant.system.circuit
    assert parts is not None
    yield Formula(
        "Brayton-Moser form (BMrlc)",
        rf"Q \dot x = \nabla P(x) + \tilde g u, \quad Q = {written_matrix(plant, parts.Q)}, \quad "
        rf"\tilde g = {written_matrix(plant, parts.g_tilde)}",
    )
    yield Formula("Dynamics (afsys)", _rates(plant))
    yield Formula(
        "Storage function (PQtilde)",
        rf"S(x) = \tilde P(x) = \tfrac12 \nabla P^{{\top}} \Xi \nabla P = {entry(plant, plant.system.S)}",
    )
