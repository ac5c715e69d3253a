"""Solve a finite program, believing nothing that was not checked here.

The walk of `solve_finite`, each step only where the ones before gave no answer that is believed:

1. `_find_contradiction`: bounds that cross, rows without entries that ask for the impossible.
2. `_list_cheap_answers`: the optimum without rows, the simplex method for a linear program of very many entries or
   without bounds, and Newton's method from a guess (`polish`), or from nothing where it is large, unless a solver was
   named. Where the simplex method finds a ray along which the cost falls, the walk ends.
3. `_solve_in_new_variables`: the program in other variables, where that makes it easier (`change_of_variables`), solved
   by this walk.
4. `_try_forms`: the program in the form that a solver takes (`standard_form`), form after form and accuracy after
   accuracy; every claim is polished, measured (`duality.measure`) and judged. Where the first is not believed, or not
   sharp enough, the solver is asked for more digits of it (`more_digits`). Where the solver says infeasible, or nothing
   is believed, the elastic program is asked how far the rows must be relaxed: its multipliers may prove infeasibility.
5. `_report_failure`: the best of what was not believed, and what was wrong with it. Where a solver was named, the walk
   begins anew without it (`solver.AccountedSolver.instead`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from sparserob_core.errors import PluginError
from sparserob_core.sip.finite import (
    CLOSED_FORM,
    DUAL_NEWTON,
    HIGHS,
    NOBODY,
    Blocks,
    Directions,
    FiniteProgram,
    FiniteSolution,
)
from sparserob_core.sip.inner.change_of_variables import NewVariables, change_variables
from sparserob_core.sip.inner.curved import add_curvature_bound
from sparserob_core.sip.inner.dual_newton import polish, solve_from_nothing
from sparserob_core.sip.inner.duality import farkas_proof, measure, minimisers, vertex_multipliers
from sparserob_core.sip.inner.more_digits import refine_claims
from sparserob_core.sip.inner.norms import (
    expand_norms,
    find_block_directions,
    of_the_rest,
    select_nearest_directions,
    spread_directions,
)
from sparserob_core.sip.inner.standard_form import Form, Recovered, has_cones, standard_form
from sparserob_core.sip.inner.vertex import has_many_entries, simplex, solve_by_sifting
from sparserob_core.sip.solver import AccountedSolver, Claim, QuadraticProgram, Solver

# The accuracy that a solver is asked for, in multiples of the tolerance, in each form, until it is believed.
ATTEMPTS: tuple[tuple[Form, float], ...] = (("split", 0.1), ("epigraph", 0.1), ("split", 1e-3), ("split", 10.0))

# The same for norms of blocks, whose form is the epigraph; at most so many programs with more and more directions each,
# and so many answers in a row that bring the bounds no nearer.
ACCURACIES = (0.1, 1e-3, 10.0)
DIRECTIONS, PATIENCE = 60, 12
# From a gap of this share of the value, and again from such a share of that gap, Newton's method is tried for so many
# steps, on blocks whose norm is more than this share of the largest.
NEARLY, NEWTON, SMALLEST = 0.03, 6, 1e-7
# Steps of the simplex method for each row and variable, at most, where another method lacks digits: an ordinary program
# takes one to three. With a third of them some are given up; ten times as many take longer than what they replace.
SIMPLEX_STEPS_PER_ROW = 10
# Rows and entries from which Newton's method begins with nothing, where every entry is bent: of 230 rows that a state
# along a wall is left with, and 2880 entries, it takes 0.4 s and an interior-point method 10.6 s; of dense random ones,
# nearly all active, half as long with 300 and 3000, as long with 120 and 1000, and with 300 and 400 ten times as long.
CROWDED, WIDE = 100, 2000
MAX_PROXIMAL_POINTS = 40  # proximal points then: 37 were needed at most; with four only easy programs are solved
# Answers in a row that a solver that was named does not call solved, and nobody believes, until another one is asked.
# With one, programs are left that the second form solves; with ten, a first-order method takes a minute for a run that
# others end in two seconds.
LOST = 3
CRUDE_ANSWER_RESIDUAL = 1e-6  # largest residual of an answer whose gap says something

ADVICE = "try another solver, or state the problem in units in which its numbers are of one size"


@dataclass
class _Case:
    """State of one call of `solve_finite`: the question, the answers so far, and why they were not believed.

    ``best`` is the best answer that is not believed; ``attempts`` says why each was not believed. ``blunt`` is the best
    believed answer that is not sharp. ``crude``: the fault of the solver's own answer, where Newton's method turned it
    into one that holds. ``lost``: how often in a row the solver has neither solved a program nor called it infeasible.
    ``elastic``: whether the elastic program was asked. ``falls``: whether the simplex method
    found a ray along which the cost falls without bound. ``small``: see `solve_finite`.
    """

    program: FiniteProgram
    solver: AccountedSolver
    tolerance: float
    small: float
    attempts: list[str] = field(default_factory=list)
    best: FiniteSolution | None = None
    blunt: FiniteSolution | None = None
    elastic: bool = False
    falls: bool = False
    crude: str = ""
    lost: int = 0

    def heard(self, claim: Claim | None) -> None:
        """Count claims in a row that are not ``solved`` nor ``infeasible``; ``None``: the solver raised."""
        if not self.given_up:
            self.lost = self.lost + 1 if claim is None or claim.status == "failed" else 0

    @property
    def given_up(self) -> bool:
        """True where the named solver has failed so often in a row that another one is asked."""
        return self.solver.instead is not None and self.lost >= LOST

    def believes(self, solution: FiniteSolution) -> bool:
        return solution.residual <= self.tolerance and solution.gap <= 10 * self.tolerance * cost_scale(
            self.program, solution.value
        )

    def _compute_gap_scale(self, solution: FiniteSolution) -> float:
        """Return the size that the gap of a sharp answer is relative to: the value, but at least ``small`` times the
        sum of the absolute parts of the cost."""
        return max(abs(solution.value), self.small * self.program.added(solution.x))

    def judge(self, solution: FiniteSolution, name: str, by: str = "") -> FiniteSolution | None:
        """Return the solution, which is ``by`` somebody, as ``optimal`` if believed and sharp; otherwise keep it, or
        note why it is not believed."""
        if solution.residual <= self.tolerance and not self.believes(solution):
            solution = add_curvature_bound(self.program, solution)
        if self.believes(solution):
            message, attempts = f"{name}: {solution.message}", tuple(self.attempts)
            believed = replace(solution, status="optimal", attempts=attempts, message=message, by=by or solution.by)
            if np.isinf(self.small) or solution.gap <= 10 * self.tolerance * self._compute_gap_scale(solution):
                return believed
            if self.blunt is None or solution.gap < self.blunt.gap:
                self.blunt = believed
            return None
        if self.best is None or solution.error < self.best.error:
            self.best = solution
        self.attempts.append(
            f"{name}: {solution.message}; not believed: residual {solution.residual:.1e}, gap {solution.gap:.1e}"
        )
        return None


@dataclass
class _TranslatedCase(_Case):
    """State of the same call in ``easier`` variables.

    Answers are judged by their residual and bound in the ``outer`` program, where no variable lacks its bounds. Where
    the outer program has equalities, the bound of the easier one counts if it is better: multipliers of equalities that
    are nearly parallel cancel, and doubles do not hold what is left.
    """

    outer: FiniteProgram = field(kw_only=True)
    easier: NewVariables = field(kw_only=True)

    def judge(self, solution: FiniteSolution, name: str, by: str = "") -> FiniteSolution | None:
        worth = _measure_translated(self.outer, self.easier, solution)
        lower = max(worth.lower_bound, solution.lower_bound) if self.outer.b.size else worth.lower_bound
        judged = replace(solution, lower_bound=lower, gap=solution.value - lower, residual=worth.residual)
        return super().judge(judged, name, by)


def _measure_translated(program: FiniteProgram, easier: NewVariables, solution: FiniteSolution) -> FiniteSolution:
    """Return a solution in easier variables as one of the ``program``, with its value and its bound."""
    x, mu = easier.back(solution.x), easier.equality_prices(solution)
    return measure(program, x, solution.y, mu, easier.dual(solution.z), solution.message)


def solve_finite(
    program: FiniteProgram,
    solver: Solver,
    *,
    tolerance: float = 1e-9,
    guess: FiniteSolution | None = None,
    small: float = np.inf,
) -> FiniteSolution:
    """Solve, trying forms and accuracies until an answer is believed.

    ``optimal`` is believed when `FiniteProgram.residual` is at most ``tolerance`` and the gap to the proven lower bound
    at most ``10 tolerance`` times `cost_scale`; ``infeasible`` only with multipliers that prove it (Farkas 1902),
    whatever the solver says. ``guess``: a solution of a program with the same numbers of rows; a separable program is
    then first tried by Newton's method. ``small``: a gap that is above ``10 tolerance`` times the value, and times this
    share of what is added up to it, is worth more digits; whether they are found or not, what is believed stays
    ``optimal``. ``solver``: what may answer before it, and who does where it does not, `AccountedSolver` says. Raises
    `InputError` when the program's shapes or numbers are at fault; a hard program is ``failed``, never an exception.
    """
    program.validate()
    counted = AccountedSolver.of(solver)
    case = _Case(program, counted, tolerance, small)
    solution = _solve_case(case, guess)
    if counted.instead is not None and solution.status == "failed":
        fallback = solve_finite(program, counted.instead, tolerance=tolerance, guess=guess, small=small)
        reason = next(iter(solution.attempts), solution.message)
        if fallback.status != "failed":
            return replace(fallback, attempts=(*solution.attempts, *fallback.attempts), unanswered=reason)
        return replace(solution, by=NOBODY, unanswered=reason)
    if counted.instead is not None and solution.by == DUAL_NEWTON != counted.name:
        return replace(solution, unanswered=case.crude)
    return solution if solution.by else replace(solution, by=NOBODY if solution.status == "failed" else counted.name)


def _solve_case(case: _Case, guess: FiniteSolution | None) -> FiniteSolution:
    program = case.program
    impossible = _find_contradiction(program, case.tolerance)
    if impossible is not None:
        return replace(impossible, by=CLOSED_FORM)
    for by, solution in _list_cheap_answers(case, guess):
        believed = case.judge(solution, "without a solver", by)
        if believed is not None:
            return believed
    if case.falls:
        return _report_failure(case)
    case.attempts.clear()
    if program.blocks is not None and program.S is None:
        return _solve_by_directions(case, program.blocks, guess)
    easier = change_variables(program)
    answer = None if easier is None else _solve_in_new_variables(case, easier, guess)
    if answer is None and program.blocks is not None:
        return _solve_by_directions(case, program.blocks, guess)
    if answer is not None:
        return answer
    return _try_forms(case)


def _solve_by_directions(case: _Case, blocks: Blocks, guess: FiniteSolution | None) -> FiniteSolution:
    """Treat norms of blocks as second-order cones, where there is a solver that takes them (`_solve_conic`). Otherwise
    treat them as the largest of ``d's`` over finitely many directions (Kelley 1960), those of the answers and those
    that their multipliers ask for. This ends where the cost with the norms themselves meets the bound."""
    program, directions = case.program, spread_directions(blocks)
    if guess is not None and np.isfinite(guess.x).all():
        wanted = find_block_directions(program, blocks, guess.x, guess.y, guess.mu, guess.z)
        guessed = () if guess.directions is None else (select_nearest_directions(guess.directions, wanted),)
        for addition in (wanted, *guessed):
            directions = directions.joined(addition)
        if program.S is None:
            start = (guess.x, guess.y, guess.mu, guess.z)
            believed, _, _ = _refine_by_newton(case, blocks, ACCURACIES[0] * case.tolerance, directions, start, np.inf)
            if believed is not None:
                return replace(believed, directions=directions)
    believed = _solve_conic(case, blocks, directions)
    if believed is not None:
        return believed
    for accuracy in ACCURACIES:
        believed, proof, directions = _solve_by_kelley(case, blocks, accuracy * case.tolerance, directions)
        if believed is None:
            believed = case.blunt or _find_elastic_proof(case, proof)
        if believed is not None:
            return replace(believed, directions=directions)
        if case.given_up:
            break
    return replace(_report_failure(case), directions=directions)


def _solve_conic(case: _Case, blocks: Blocks, directions: Directions) -> FiniteSolution | None:
    """Return a believed answer of a solver that takes second-order cones, or its proof that there is none; ``None``
    without such a solver. Along a norm whose bounds are reached the cost is flat, and the bound asks for more digits of
    the decision than such a solver has: Newton's method goes on from there, with ``directions`` for the blocks that are
    0."""
    program, cones = case.program, case.solver.cones
    if cones is None or not has_cones(program, blocks):
        return None
    for accuracy in ACCURACIES:
        claim, answer = _ask_solver(case, program, "cones", accuracy * case.tolerance)
        if claim is not None and claim.status == "infeasible":
            proof = _check_proof(case, answer, "the solver's ray")
            return None if proof is None else replace(proof, by=cones[1])
        if answer is not None and np.isfinite(answer[0]).all():
            believed, gap = _judge_answer(case, answer, "with cones", cones[1])
            if believed is None and program.S is None and gap < np.inf:
                believed, _, _ = _refine_by_newton(case, blocks, accuracy * case.tolerance, directions, answer, gap)
            if believed is not None:
                return believed
    return case.blunt


def _solve_by_kelley(
    case: _Case, blocks: Blocks, accuracy: float, directions: Directions
) -> tuple[FiniteSolution | None, FiniteSolution | None, Directions]:
    """Return a believed answer, or a proof that there is none, or neither; and the directions used. Where an answer is
    near, Newton's method is tried from it: it knows the curvature of the norms, but not which blocks are 0."""
    program, closest, tried, idle = case.program, np.inf, np.inf, 0
    for _ in range(DIRECTIONS):
        claim, answer = _ask_solver(case, program, "epigraph", accuracy, directions)
        if claim is not None and claim.status == "infeasible":
            return None, _check_proof(case, answer, "the solver's ray"), directions
        if answer is None or not np.isfinite(answer[0]).all():
            break
        believed, gap = _judge_answer(case, answer)
        if (
            believed is None
            and program.S is None
            and gap <= NEARLY * min(tried, cost_scale(program, program.objective(answer[0])))
        ):
            tried = gap
            believed, answer, gap = _refine_by_newton(case, blocks, accuracy, directions, answer, gap)
        if believed is not None:
            return believed, None, directions
        idle = 0 if gap < 0.9 * closest else idle + 1
        closest = min(closest, gap)
        x, y, mu, z = answer
        extended = directions.joined(find_block_directions(program, blocks, x, y, mu, z))
        if idle > PATIENCE or extended.block.size == directions.block.size or case.given_up:
            break
        directions = extended
    return None, None, directions


def _judge_answer(
    case: _Case, answer: Recovered, name: str = "by directions", by: str = ""
) -> tuple[FiniteSolution | None, float]:
    """Return a believed solution, if the answer is one, and its gap: with its own multipliers or those of the tangent
    there, whichever prove more."""
    x, y, mu, z = answer
    gap = np.inf
    for offer in ((y, mu), vertex_multipliers(case.program.tangent(x), x, y, mu)):
        solution = measure(case.program, x, *offer, z, message="claimed")
        believed = case.judge(solution, name, by)
        gap = min(gap, solution.gap if solution.residual <= CRUDE_ANSWER_RESIDUAL else np.inf)
        if believed is not None:
            return believed, gap
    return None, gap


def _refine_by_newton(
    case: _Case, blocks: Blocks, accuracy: float, directions: Directions, answer: Recovered, gap: float
) -> tuple[FiniteSolution | None, Recovered, float]:
    """Return a believed solution, the best answer and its gap, by second-order expansions of the norms that are not 0;
    the others keep their directions."""
    program = case.program
    norms = blocks.norms(answer[0])
    moving = norms > SMALLEST * norms.max(initial=0.0)
    centre = answer[0]
    for _ in range(NEWTON):
        if not moving.any() or case.given_up:
            break
        step = expand_norms(program, blocks, centre, moving)
        fixed_directions = None if step.blocks is None else of_the_rest(directions, moving, step.blocks.table.shape[1])
        _, candidate = _ask_solver(case, step, "epigraph", accuracy, fixed_directions)
        if candidate is None or not np.isfinite(candidate[0]).all():
            break
        believed, candidate_gap = _judge_answer(case, candidate)
        if believed is not None or not candidate_gap < 0.5 * gap:
            return believed, answer, gap
        answer, gap = candidate, candidate_gap
        moving = moving & (blocks.norms(candidate[0]) > SMALLEST * norms.max())
        centre = candidate[0]
    return None, answer, gap


def _try_forms(case: _Case) -> FiniteSolution:
    """Try form after form, accuracy after accuracy."""
    attempts = _order_attempts(case.program)
    for form, factor in attempts:
        claim, answer = _ask_solver(case, case.program, form, factor * case.tolerance)
        proof = (
            _check_proof(case, answer, "the solver's ray")
            if claim is not None and claim.status == "infeasible"
            else None
        )
        message = "" if claim is None else claim.message
        for by, solution in _list_candidates(case, answer, message) if proof is None else ():
            believed = case.judge(solution, f"{form} form", by)
            if believed is not None:
                return believed
        if (form, factor) == attempts[0] and proof is None:
            believed = _sharpen(case, claim, answer)
            if believed is not None:
                return believed
        if case.blunt is not None:
            return case.blunt
        if case.given_up and proof is None:
            break
        if proof is not None or form == attempts[0][0] or (claim is not None and claim.status == "infeasible"):
            proof = _find_elastic_proof(case, proof)
        if proof is not None:
            return proof
    return _report_failure(case)


def _order_attempts(program: FiniteProgram) -> tuple[tuple[Form, float], ...]:
    """Return the forms and accuracies in the order in which they are tried: parts would double a dense matrix."""
    dense = program.P is not None and program.S is None and program.curvature is None
    return (ATTEMPTS[1], ATTEMPTS[0], *ATTEMPTS[2:]) if dense else ATTEMPTS


def _sharpen(case: _Case, claim: Claim | None, answer: Recovered | None) -> FiniteSolution | None:
    """Return the first answer that is believed and sharp: more digits of the ``claim``, and a vertex, which comes first
    where the solver has an answer that lacks digits, and last where it goes somewhere and does not arrive. Where it
    gave up, a proof that there is no answer comes before more digits. Failures are reported."""
    believed = None
    if claim is not None and claim.status == "failed":
        believed = _find_elastic_proof(case, None)
    elif claim is not None and claim.status == "solved" and answer is not None:
        believed = _solve_by_simplex(case)
    believed = believed or _refine_digits(case, claim)
    is_stalled = claim is not None and claim.status == "failed" and np.isfinite(claim.x).all() and claim.x.any()
    return _solve_by_simplex(case) if believed is None and is_stalled else believed


def _solve_by_simplex(case: _Case) -> FiniteSolution | None:
    """Return the answer of the simplex method to a linear program, if it is believed and sharp. An interior-point
    method may lack digits, as with rows that are nearly parallel, or go in circles; a vertex is a system of equations.
    Nothing where a solver was named."""
    for solution in _list_corners(case) if HIGHS in case.solver.quick else ():
        believed = case.judge(solution, "a vertex", HIGHS)
        if believed is not None:
            return believed
    return None


def _list_corners(case: _Case) -> Iterator[FiniteSolution]:
    """Yield the vertex of the simplex method with its multipliers, and with those of the vertex; of a program that is
    not linear, none."""
    program = case.program
    if program.P is not None or program.blocks is not None:
        return
    corner = simplex(program, SIMPLEX_STEPS_PER_ROW * (program.n + program.h.size + program.b.size))
    if corner.status == "unbounded":
        case.falls = True
        case.attempts.append("the simplex method: the cost falls without bound")
    if corner.status != "optimal":
        return
    yield measure(program, corner.x, corner.y, corner.mu, corner.z, message="simplex method")
    if program.S is None:
        y, mu = vertex_multipliers(program, corner.x, corner.y, corner.mu)
        yield measure(program, corner.x, y, mu, corner.z, message="simplex method")


def _refine_digits(case: _Case, claim: Claim | None) -> FiniteSolution | None:
    """Return the first refined answer that is believed and sharp, from nothing and then from the ``claim``."""
    form, factor = ATTEMPTS[0]
    qp, recover = standard_form(case.program, form)
    usable = claim is not None and _is_well_formed(claim, qp) and np.isfinite(claim.x).all()
    for start in (None, claim) if usable else (None,):
        badness = np.inf
        try:
            for refined_claim in refine_claims(qp, case.solver, start, factor * case.tolerance):
                case.heard(refined_claim)
                candidates = list(_list_candidates(case, recover(refined_claim), refined_claim.message))
                judged = [case.judge(solution, "with more digits", by) for by, solution in candidates]
                believed = [solution for solution in judged if solution is not None]
                if believed:  # digits are what was asked for: of those that are believed, the one that misses least
                    return min(believed, key=lambda solution: solution.residual)
                before = badness
                badness = min([badness, *(solution.error for _, solution in candidates)])
                if badness > 0.5 * before or case.given_up:
                    break
        except Exception as error:  # noqa: BLE001  as in `_ask_solver`
            case.attempts.append(f"with more digits: the solver raised {type(error).__name__}: {error}")
    return None


def _solve_in_new_variables(case: _Case, easier: NewVariables, guess: FiniteSolution | None) -> FiniteSolution | None:
    """Return the answer found in easier variables, checked in those of the program."""
    program = case.program
    fits = guess is not None and guess.x.size == program.n and guess.mu.size == program.b.size
    start = easier.translate(guess) if guess is not None and fits and guess.y.size == program.h.size else guess
    inner = _TranslatedCase(easier.program, case.solver, case.tolerance, case.small, outer=program, easier=easier)
    easier.program.validate()
    solution = _solve_case(inner, start)
    case.crude = inner.crude
    case.attempts += inner.attempts
    case.lost = inner.lost
    if solution.status == "infeasible":
        x, mu = easier.back(solution.x), easier.equality_prices(solution)
        proof = _check_proof(case, (x, solution.y, mu, None), "the program in other variables")
        return proof if proof is None else replace(proof, by=solution.by)
    measured = replace(_measure_translated(program, easier, solution), by=solution.by)
    believed = case.judge(measured, "new variables") or case.blunt
    if believed is None and easier.divided is not None and solution.status == "optimal":
        return replace(
            measured, status="optimal", attempts=tuple(case.attempts)
        )  # its bound is the one of this program
    return believed


def cost_scale(program: FiniteProgram, value: float) -> float:
    """Return the size that a gap is relative to: the value, but at least the largest coefficient of the cost or 1,
    whichever is smaller."""
    largest = program.steepest
    if program.P is not None:
        largest = max(largest, float(np.abs(program.P.data).max(initial=0.0)))
    return max(abs(value), min(1.0, largest or 1.0))


def _list_cheap_answers(case: _Case, guess: FiniteSolution | None) -> Iterator[tuple[str, FiniteSolution]]:
    """Yield answers that need no solver, each with the name of the method that it is by.

    These are the optimum without rows; the simplex method, where few of many entries matter to it; and Newton's method
    from a guess, or from nothing where the program is large. Where a solver was named, there are none.
    """
    program, quick = case.program, case.solver.quick
    if CLOSED_FORM in quick and program.separable:
        x = minimisers(program.weights, program.curvature, program.q, program.lower, program.upper)
        if np.isfinite(x).all() and program.residual(x) <= case.tolerance:
            zero, none = np.zeros(program.h.size), np.zeros(program.b.size)
            yield CLOSED_FORM, measure(program, x, zero, none, message="no row is active")
    if HIGHS in quick and program.S is None and not program.bounded:  # where others take long, and a vertex is exact
        yield from ((HIGHS, solution) for solution in _list_corners(case))
    if HIGHS in quick and has_many_entries(program):
        corner = solve_by_sifting(program, *((None, None) if guess is None else (guess.y, guess.mu)))
        if corner.status == "optimal":
            yield HIGHS, measure(program, corner.x, corner.y, corner.mu, message="simplex method")
    if DUAL_NEWTON in quick and guess is not None:
        polished = polish(program, guess.x, guess.y, guess.mu)
        if polished is not None:
            yield DUAL_NEWTON, polished
    large = program.separable and program.h.size >= CROWDED and program.n >= WIDE
    if DUAL_NEWTON in quick and large and program.curvature is not None and program.curvature.min() > 0.0:
        yield DUAL_NEWTON, solve_from_nothing(program, 0.1 * case.tolerance, MAX_PROXIMAL_POINTS)[0]


def _ask_solver(
    case: _Case, program: FiniteProgram, form: Form, accuracy: float, directions: Directions | None = None
) -> tuple[Claim | None, Recovered | None]:
    """Return the solver's claim, and its numbers in terms of the program if they have the right shapes and are
    finite."""
    qp, recover = standard_form(program, form, directions)
    try:
        claim = case.solver.solve(qp, accuracy)
    except Exception as error:  # noqa: BLE001  a foreign solver may raise anything; its failure must not be ours
        message = str(error) if isinstance(error, PluginError) else f"the solver raised {type(error).__name__}: {error}"
        case.attempts.append(f"{form} form: {message}")
        case.heard(None)
        return None, None
    case.heard(claim)
    if not _is_well_formed(claim, qp):
        shapeless = "; its arrays are not finite, or not of the right size" if claim.status == "solved" else ""
        case.attempts.append(f"{form} form: {claim.status}, {claim.message}{shapeless}")
        return claim, None
    return claim, recover(claim)


def _is_well_formed(claim: Claim, qp: QuadraticProgram) -> bool:
    pairs = ((claim.x, qp.q), (claim.z, qp.h), (claim.y, qp.b))
    return all(np.shape(got) == want.shape and bool(np.isfinite(got).all()) for got, want in pairs)


def _list_candidates(case: _Case, answer: Recovered | None, said: str) -> Iterator[tuple[str, FiniteSolution]]:
    """A claim of a solver that ``said`` so, polished, where the structure allows, and as it is, and who each is by. The
    polished one of a solver that was named is its own answer only where the claim would do."""
    if answer is None:
        return
    program, (x, y, mu, z) = case.program, answer
    raw, polished = measure(program, x, y, mu, z, message=f"claimed ({said})"), polish(program, x, y, mu)
    if polished is not None:
        by = "" if case.solver.quick or case.believes(raw) else DUAL_NEWTON
        case.crude = f"its answer {_describe_errors(raw)}; Newton's method went on from it" if by else ""
        yield by, polished
        vertex = vertex_multipliers(program, polished.x, polished.y, polished.mu)
        yield by, measure(program, polished.x, *vertex, message="its vertex")
    yield "", raw


def _find_elastic_proof(case: _Case, known: FiniteSolution | None) -> FiniteSolution | None:
    """Return the sharpest proof of infeasibility, from the elastic program or already known; sought once."""
    if case.elastic:
        return known
    case.elastic = True
    for by, answer in _list_elastic_answers(case, ("split", "epigraph") if known is None else ("split",)):
        proof = _check_proof(case, interpret_elastic_answer(case.program, answer), "the elastic program")
        if proof is not None and (known is None or proof.infeasibility > known.infeasibility):
            return replace(proof, by=by)
    return known


def _list_elastic_answers(case: _Case, forms: tuple[Form, ...]) -> Iterator[tuple[str, Recovered]]:
    """Yield answers to the elastic program, each with the name of the method that it is by: a vertex, where no solver
    was named, and the solver's in each form until it calls one solved."""
    relaxed = elastic_program(case.program)
    if HIGHS in case.solver.quick:
        corner = simplex(relaxed, SIMPLEX_STEPS_PER_ROW * (relaxed.n + relaxed.h.size))
        if corner.status == "optimal":
            yield HIGHS, (corner.x, corner.y, corner.mu, corner.z)
    for form in forms:
        claim, answer = _ask_solver(case, relaxed, form, 0.1 * case.tolerance)
        if answer is not None:
            yield "", answer
        if claim is not None and claim.status == "solved":
            return


def _check_proof(case: _Case, answer: Recovered | None, source: str) -> FiniteSolution | None:
    """Return the answer as ``infeasible``, if its multipliers prove that."""
    if answer is None:
        return None
    program, (x, y, mu, z) = case.program, answer
    bound = farkas_proof(program, y, mu, z, case.tolerance)
    if bound is None:
        return None
    measured = measure(program, x, y, mu, z)
    message = (
        f"infeasible: the rows must be relaxed by at least {bound:.6g} of their norm; proven by the multipliers of"
        f" {source}"
    )
    return replace(measured, status="infeasible", message=message, attempts=tuple(case.attempts), infeasibility=bound)


def elastic_program(program: FiniteProgram) -> FiniteProgram:
    """Return the program that minimises ``t >= 0`` subject to the bounds, ``G_i x <= h_i + t |G_i|`` and
    ``|A_i x - b_i| <= t |A_i|``.

    Its decision is ``(x, t)``; its rows are those of ``G``, then ``A x - b <= t |A|``, then ``b - A x <= t |A|``. It is
    always feasible (when the bounds are, and rows without entries hold), and a positive value proves the program
    infeasible.
    """
    images = program.weights.size
    rows = np.vstack([program.G, program.A, -program.A])
    rows = np.hstack([rows, -np.linalg.norm(rows, axis=1)[:, None]])
    S = None
    if program.S is not None:
        from scipy.sparse import block_diag

        S = block_diag([program.S, [[1.0]]], format="csc")
    q = np.zeros(program.n + 1)
    q[-1] = 1.0
    return FiniteProgram(
        q,
        np.zeros(images + 1),
        np.append(program.lower, 0.0),
        np.append(program.upper, np.inf),
        rows,
        np.concatenate([program.h, program.b, -program.b]),
        np.zeros((0, program.n + 1)),
        np.zeros(0),
        S=S,
    )


def interpret_elastic_answer(program: FiniteProgram, answer: Recovered) -> Recovered:
    """Return an answer to the elastic program in terms of ``program``: its ``x``, and multipliers that may prove
    infeasibility."""
    x, multipliers, _, z = answer
    r, e = program.h.size, program.b.size
    y = np.maximum(multipliers, 0.0)
    return x[:-1], y[:r], y[r : r + e] - y[r + e :], None if z is None else z[:-1]


def _find_contradiction(program: FiniteProgram, tolerance: float) -> FiniteSolution | None:
    """Return ``infeasible`` for bounds that cross, or rows without entries that ask for the impossible, else
    ``None``."""
    y, mu, x = np.zeros(program.h.size), np.zeros(program.b.size), np.zeros(program.n)
    crossed = program.lower - program.upper
    if crossed.max(initial=0.0) > 0:
        k = int(np.argmax(crossed))
        reason, amount = (
            f"the bounds of image entry {k} cross: {program.lower[k]} > {program.upper[k]}",
            float(crossed[k]),
        )
    elif (short := program.h < -tolerance).any() and (short := short & ~program.G.any(axis=1)).any():
        i = int(np.argmax(short))
        y[i] = 1.0
        reason, amount = f"row {i} has no entries and asks for 0 <= {program.h[i]}", np.inf
    elif program.b.size and (short := ~program.A.any(axis=1) & (np.abs(program.b) > tolerance)).any():
        i = int(np.argmax(short))
        mu[i] = -np.sign(program.b[i])
        reason, amount = f"equality {i} has no entries and asks for 0 = {program.b[i]}", np.inf
    else:
        return None
    z = np.zeros(program.weights.size)
    return FiniteSolution("infeasible", x, np.inf, np.inf, y, mu, z, np.inf, 0.0, f"infeasible: {reason}", (), amount)


def _report_failure(case: _Case) -> FiniteSolution:
    program, best = case.program, case.best
    if best is None:
        best = measure(program, np.zeros(program.n), np.zeros(program.h.size), np.zeros(program.b.size))
        reason = "; ".join(dict.fromkeys(case.attempts)) or "the solver gave no answer"
    else:
        reason = f"of {len(case.attempts)} answers none holds: the best {_describe_errors(best)}"
    return replace(best, status="failed", message=f"{reason}; {ADVICE}", attempts=tuple(case.attempts))


def _describe_errors(solution: FiniteSolution) -> str:
    """Describe the residual of an answer and its distance to its own lower bound, in words."""
    side = "above" if solution.gap >= 0.0 else "below"  # where it misses its rows
    bound = "has no lower bound" if solution.gap == np.inf else f"is {abs(solution.gap):.1e} {side} its lower bound"
    return f"misses its rows by {solution.residual:.1e} and {bound}"
