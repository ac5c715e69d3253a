"""Other tools for plans of plants that amplify, as their own pages tell to write them; each needs a package of its own,
which the project does not."""

from __future__ import annotations

from typing import Any

import numpy as np

from tests.support.nodes import Shot


def in_time(options: dict[str, Any]) -> tuple[np.ndarray, np.ndarray, int, float, np.ndarray]:
    """Return ``A``, ``B``, the number of pieces, their length, and the walls of a config."""
    problem, pieces = options["problem"], int(options["dictionaries"]["control"]["pieces"])
    A, B = (np.array(problem["system"][name], dtype=float) for name in "AB")
    walls = np.array(problem["path"][0]["box"], dtype=float)
    return A, B, pieces, problem["horizon"] / pieces, np.where(np.isnan(walls), np.inf, walls)


def by_do_mpc(options: dict[str, Any]) -> Shot:
    """do-mpc: collocation within pieces, Ipopt; ``u = p - n`` with both charged."""
    import casadi
    import do_mpc

    problem = options["problem"]
    (A, B, pieces, step, walls), bound = in_time(options), problem["control"]["box"]
    m = B.shape[1]
    model = do_mpc.model.Model("continuous")
    x = model.set_variable("_x", "x", shape=(len(A), 1))
    up, down = (model.set_variable("_u", name, shape=(m, 1)) for name in ("up", "down"))
    model.set_rhs("x", A @ x + B @ (up - down))
    model.setup()
    mpc = do_mpc.controller.MPC(model)
    quiet = {"ipopt.print_level": 0, "print_time": 0, "ipopt.sb": "yes", "ipopt.tol": 1e-10}
    mpc.set_param(n_horizon=pieces, t_step=step, nlpsol_opts=quiet)
    mpc.set_objective(mterm=casadi.DM(0), lterm=step * (casadi.sum1(up) + casadi.sum1(down)))
    mpc.set_rterm(up=0.0, down=0.0)
    for name in ("up", "down"):
        mpc.bounds["lower", "_u", name] = np.zeros((m, 1))
        mpc.bounds["upper", "_u", name] = np.full((m, 1), bound)
    mpc.bounds["lower", "_x", "x"], mpc.bounds["upper", "_x", "x"] = -walls[:, None], walls[:, None]
    ends = np.array(problem["terminal"][0]["equals"], dtype=float)[:, None]
    mpc.terminal_bounds["lower", "x"] = np.where(np.isnan(ends), -np.inf, ends)
    mpc.terminal_bounds["upper", "x"] = np.where(np.isnan(ends), np.inf, ends)
    mpc.prepare_nlp()
    plan = [mpc.opt_x["_u", k, 0] for k in range(pieces)]
    if "control_step" in problem:
        change, before = problem["control_step"]["box"], casadi.DM(problem["initial_control"])
        for entry in plan:
            control = entry[:m] - entry[m:]
            mpc.nlp_cons.append(control - before)
            mpc.nlp_cons_lb.append(np.full((m, 1), -change))
            mpc.nlp_cons_ub.append(np.full((m, 1), change))
            before = control
    mpc.create_nlp()
    start = np.array(problem["initial_state"], dtype=float)[:, None]
    mpc.x0 = start
    mpc.set_initial_guess()
    mpc.make_step(start)
    assert mpc.solver_stats["success"], mpc.solver_stats["return_status"]
    halves = np.hstack([np.array(mpc.opt_x_num["_u", k, 0]).reshape(-1, 1) for k in range(pieces)])
    control = halves[:m] - halves[m:]
    return Shot(float(step * np.abs(control).sum()), control)


def by_openscvx(options: dict[str, Any], iterations: int = 100) -> Shot:
    """OpenSCvx: successive convexification, walls by its penalty at all times (``ctcs``); ``|u|`` is the rate of an
    effort. With its own weights it stops early; these are the best of those that were tried."""
    import openscvx as ox

    problem = options["problem"]
    (A, B, pieces, step, walls), bound = in_time(options), problem["control"]["box"]
    (d, m), horizon = B.shape, problem["horizon"]
    start, end = (
        np.array(values, dtype=float) for values in (problem["initial_state"], problem["terminal"][0]["equals"])
    )
    ranges = 10.0 * np.maximum(np.where(np.isfinite(walls), walls, 1.0), np.maximum(np.abs(start), np.abs(end)))
    x, effort = ox.State("x", shape=(d,)), ox.State("effort", shape=(1,))
    x.min, x.max, x.initial, x.final = -ranges, ranges, start, end
    x.guess = np.linspace(start, end, pieces + 1)
    effort.min, effort.max, effort.initial = [0.0], [m * bound * horizon], [0.0]
    effort.final, effort.guess = [ox.Minimize(0.1)], np.linspace([0.0], [0.1], pieces + 1)
    u, size = (ox.Control(name, shape=(m,), parameterization="ZOH") for name in ("u", "size"))
    u.min, u.max, u.guess = [-bound] * m, [bound] * m, np.zeros((pieces + 1, m))
    size.min, size.max, size.guess = [0.0] * m, [bound] * m, np.full((pieces + 1, m), 0.1 * bound)
    held = [i for i in range(d) if np.isfinite(walls[i])]
    constraints = [
        *(ox.ctcs(x[i] <= walls[i]) for i in held), *(ox.ctcs(-walls[i] <= x[i]) for i in held),
        (u <= size).convex(), (-size <= u).convex(),
    ]  # fmt: skip
    driven = ox.Constant(A) @ x
    for i in range(m):
        driven = driven + ox.Constant(B[:, i]) * u[i]
    plan = ox.Problem(
        dynamics={"x": driven, "effort": sum((size[i : i + 1] for i in range(1, m)), size[0:1])},
        constraints=constraints,
        states=[x, effort],
        controls=[u, size],
        time=ox.Time(initial=0.0, final=horizon, min=0.0, max=horizon, uniform_time_grid=True),
        N=pieces + 1,
        float_dtype="float64",
        algorithm={"lam_cost": 10.0, "lam_vc": 1e4, "ep_tr": 1e-9, "k_max": iterations},
    )
    plan.initialize()
    solution = plan.solve()
    control = np.asarray(solution.u[:pieces, :m]).T
    return Shot(float(step * np.abs(control).sum()), np.ascontiguousarray(control))
