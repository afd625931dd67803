"""What the results of a study mean for the designer: what limits the winner, and what to try next."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from softgym_envs.codesign.records import REFINED
from softgym_envs.codesign.results import StudyResults
from softgym_envs.codesign.snapshot import StudySnapshot
from softgym_envs.codesign.statistics import MIN_GOALS, mean_interval
from softgym_envs.units import present
from softgym_envs.wording import counted

NEGLIGIBLE = 0.1
"""A difference of mean distances below this share of the success distance does not matter."""

SUBSTANTIAL = 0.25
"""Part of the distance that is left which another controller must close for the policy to be what limits."""

TRUSTED = 0.9
"""Share of trusted states below which a search on the surrogate is doubtful."""

COSTLIER = 1.1
"""Ratio of the winner's effort, strain or self-contact to the baseline's from which it is part of the result."""

PRESSED = 0.1
"""Self-contact below which it does not matter [N]."""


@dataclass(frozen=True)
class Finding:
    """One finding.

    Attributes:
        title: the finding in a few words.
        text: its numbers, and what to do.
        warns: whether it limits the result.
    """

    title: str
    text: str
    warns: bool = True


def findings(snapshot: StudySnapshot, results: StudyResults) -> list[Finding]:
    """Return the findings of a study, the most important ones first; without a winner only that its code changed."""
    if results.winner is None:
        found = [_code(results)]
        return [finding for finding in found if finding is not None]
    found = [
        _code(results),
        _goals(snapshot, results),
        _trust(snapshot, results),
        _physics(snapshot, results),
        _ranking(snapshot, results),
        _effort(snapshot, results),
        _mesh(snapshot, results),
        _failures(snapshot),
        _limit(snapshot, results),
        _bounds(results),
        _alternatives(snapshot, results),
    ]
    if results.few_goals:
        found.append(Finding("Few test goals", f"{results.few_goals} Raise goals.unseen_count."))
    return [finding for finding in found if finding is not None]


def _code(results: StudyResults) -> Finding | None:
    """Return whether the results come from more than one state of the code."""
    changes = results.provenance.get("code_changes")
    if not changes:
        return None
    text = ". ".join(f"The study was {change}" for change in changes)
    return Finding(
        "The code changed during the study",
        f"{text}. What they compute may differ; a study in a new folder has one state of the code.",
    )


def _goals(snapshot: StudySnapshot, results: StudyResults) -> Finding | None:
    row = next((row for row in results.comparison if row.backend == "fem"), None)
    if row is None:
        return None
    scale = snapshot.config.distance_scale
    limit = scale.limit_text(results.success_distance)
    missed = round(row.goals * (1.0 - row.winner.success_rate))
    if not missed:
        return Finding(
            "Every test goal is reached",
            f"{counted(row.goals, 'goal')} on FEM, each with a final {scale.name} of at most {limit}.",
            warns=False,
        )
    reached = {group.key: group.mean.successes >= 0.5 for group in snapshot.unseen_tests}
    before, after = (reached[body.trial, row.agent, "fem"] for body in (results.baseline, results.winner) if body)
    lost = int((before & ~after).sum())
    title = f"{missed} of {counted(row.goals, 'test goal')} {'is' if missed == 1 else 'are'} not reached"
    text = f"The largest {scale.name} is {scale.text(row.winner.worst_distance, 2)}; a goal is reached within {limit}."
    return Finding(title, f"{text} The baseline reaches {lost} of them." if lost else text)


def _trust(snapshot: StudySnapshot, results: StudyResults) -> Finding | None:
    """Return how much of what the bodies did on the surrogate is to be trusted, if that is little."""
    shares = {}
    for role, body in (("baseline", results.baseline), ("winner", results.winner)):
        tests = [g for g in snapshot.unseen_tests if body and g.trial == body.trial and g.backend == "surrogate"]
        known = [test.table("untrusted") for test in tests]
        known = [table for table in known if np.isfinite(table).all()]
        if body is not None and known:
            shares[role] = 1.0 - float(np.concatenate(known, axis=None).mean())
    if not shares or min(shares.values()) >= TRUSTED:
        return None
    texts = " and ".join(f"{share:.0%} of the states of the {role}" for role, share in shares.items())
    return Finding(
        "The surrogate is little trusted",
        f"It trusts {texts}. A search on it may have found its errors: believe the rows on FEM, fit it with more "
        "bodies (softgym fit says where it can be trusted), or run the study on FEM or hybrid.",
    )


def _physics(snapshot: StudySnapshot, results: StudyResults) -> Finding | None:
    """Return whether the winner's distance on the surrogate is another one than on FEM."""
    assert results.winner is not None
    rows = {(row.backend, row.agent): row for row in results.comparison}
    measure = snapshot.config.distance
    for agent in results.winner.agents:
        pair = [rows.get((backend, agent)) for backend in ("surrogate", "fem")]
        if pair[0] is None or pair[1] is None:
            continue
        for role in ("winner", "baseline"):
            learned, real = (getattr(row, role).mean_distance for row in pair)
            if abs(real - learned) > max(results.success_distance, SUBSTANTIAL * max(real, learned)):
                return Finding(
                    "Surrogate and FEM disagree",
                    f"The {measure.label.lower()} of the {role} is {measure.text(learned)} on the surrogate, where "
                    f"the search ran, and {measure.text(real)} on FEM. Only FEM counts; fit it with more bodies.",
                )
    return None


def _is_about_distance(snapshot: StudySnapshot) -> bool:
    """Return whether the better of two bodies is the one that ends nearer to its goals."""
    return snapshot.config.objective in ("mean_distance", "success_rate")


def _ranking(snapshot: StudySnapshot, results: StudyResults) -> Finding | None:
    """Return whether the inverse QP on FEM, which needs no training, prefers the baseline that the policies left."""
    if results.winner is None or results.winner.role == "baseline" or not _is_about_distance(snapshot):
        return None
    if results.winner.agents[0] == "qp":  # no policy that could be easier to train
        return None
    row = next((row for row in results.comparison if (row.backend, row.agent) == ("fem", "qp")), None)
    if row is None or not row.distance_change > NEGLIGIBLE * results.success_distance:
        return None
    measure = snapshot.config.distance
    return Finding(
        "With the inverse QP, the baseline is the better body",
        f"On FEM it ends at {measure.text(row.baseline.mean_distance)} with the baseline and at "
        f"{measure.text(row.winner.mean_distance)} with the winner. The winner may only be easier to train for; "
        "strategy: qp compares bodies without training.",
    )


def _effort(snapshot: StudySnapshot, results: StudyResults) -> Finding | None:
    """Return whether the winner needs larger efforts or strains than the baseline, or presses itself shut."""
    if results.winner is None or results.winner.role == "baseline":
        return None
    agent = results.winner.agents[0]
    row = next((row for row in results.comparison if (row.backend, row.agent) == ("fem", agent)), None)
    if row is None:
        return None
    parts = []
    for kind in ("mean", "largest"):
        before, after = (getattr(body, f"{kind}_effort") for body in (row.baseline, row.winner))
        if before and after and after > COSTLIER * before:
            effort = snapshot.config.effort
            parts.append(f"{kind} effort is {effort.text(after)} instead of {effort.text(before)}")
    limits = ["largest_effort"] if parts else []
    for kind, words, unit, least in (
        ("largest_strain", "largest strain of a drive", "%", 0.0),
        ("self_force", "self-contact", "N", PRESSED),
    ):
        before, after = (getattr(body, kind) for body in (row.baseline, row.winner))
        if before is None or after is None or after <= max(COSTLIER * before, least):
            continue
        shown = [f"{100 * value:.1f} %" if unit == "%" else present(value, unit) for value in (after, before)]
        parts.append(f"{words} is {shown[0]} instead of {shown[1]}")
        limits.append(kind)
    if not parts:
        return None
    return Finding(
        "The winner pulls harder" if "largest_effort" in limits else "The winner strains more",
        f"On FEM its {' and its '.join(parts)}: part of its gain may be the stronger drive. A study with constraints "
        f"on {' and '.join(limits)} would compare them at equal cost.",
    )


def _mesh(snapshot: StudySnapshot, results: StudyResults) -> Finding | None:
    """Return whether a finer mesh agrees that the winner is nearer to the goals."""
    finer = snapshot.config.finalists.refinement
    if finer is None or results.winner is None or results.winner.role == "baseline":
        return None
    failed = next((test for test in results.tests if test.backend == REFINED and test.error is not None), None)
    if failed is not None:
        text = f"Trial {failed.trial} cannot be simulated there: {failed.error}. No interval contains the mesh's error."
        return Finding("The finer mesh has no result", text)
    rows = {(row.backend, row.agent): row for row in results.comparison}
    agent = results.winner.agents[0]
    coarse, fine = (rows.get((backend, agent)) for backend in ("fem", REFINED))
    if coarse is None or fine is None or coarse.distance_mesh is None:
        return None
    measure, mesh, own = snapshot.config.distance, coarse.distance_mesh, "the mesh of the study"
    kinds = f", half of them missed by the baseline on {own}," if finer.choose == "missed" else ""
    text = (
        f"At {counted(fine.goals, 'goal')}{kinds} the change is {measure.text(fine.distance_change, '+')} on the finer "
        f"mesh and {measure.text(mesh.before, '+')} on {own}. "
    )
    if mesh.interval is None:
        return Finding("A finer mesh was tested", f"{text}With fewer than {MIN_GOALS} goals there is no interval.")
    low, high = (measure.number(end, "+") for end in mesh.interval)
    text += f"With what is left of the mesh's error, the change at all goals is {low} to {high} {measure.display.unit}."
    if mesh.interval[1] < 0.0:
        return Finding("A finer mesh agrees", text, warns=False)
    return Finding("With the mesh's error, the gain is not certain", text)


def _failures(snapshot: StudySnapshot) -> Finding | None:
    """Return which finalists cannot be simulated on FEM."""
    failed = snapshot.failures
    if not failed:
        return None
    texts = ". ".join(f"Trial {trial}: {error}" for trial, error in failed.items())
    title = (
        f"{len(failed)} of {counted(len(snapshot.finalists), 'body')} {'fails' if len(failed) == 1 else 'fail'} on FEM"
    )
    return Finding(title, f"{'It' if len(failed) == 1 else 'They'} cannot win. {texts}.")


def _limit(snapshot: StudySnapshot, results: StudyResults) -> Finding | None:
    """Return whether the body or its policy limits the winner, by comparison with the inverse QP on the same body."""
    assert results.winner is not None
    tests = {group.key: group for group in snapshot.unseen_tests}
    policy, qp = (tests.get((results.winner.trial, agent, "fem")) for agent in ("policy", "qp"))
    if policy is None or qp is None or policy.mean.success_rate == 1.0:
        return None
    gain = policy.mean.mean_distance - qp.mean.mean_distance
    measure = snapshot.config.distance
    interval = mean_interval(policy.table("distances"), qp.table("distances"))
    trained, solved = (measure.text(group.mean.mean_distance) for group in (policy, qp))
    means = f"{measure.label.lower()} is {trained} with its policy and {solved} with the inverse QP"
    closes = gain > max(NEGLIGIBLE * results.success_distance, SUBSTANTIAL * policy.mean.mean_distance)
    if closes and (interval is None or interval[0] > 0.0):
        return Finding(
            "The policy limits, not the body",
            f"On the same body the {means}. Train longer (finalists.steps), or let the policy correct the "
            "inverse QP (environment.residual_scale).",
        )
    return Finding(
        "The body limits, not the policy",
        f"The {means}, which knows the mechanical model and needs no training. More training will "
        "hardly help; other variables, wider ranges or nearer goals may.",
    )


def _bounds(results: StudyResults) -> Finding | None:
    ended = [variable for variable in results.variables if variable.at_limit]
    if not ended:
        return None
    parts = [
        f"{variable.name.replace('_', ' ')} at its {variable.at_limit} limit of "
        f"{present(variable.low if variable.at_limit == 'lower' else variable.high, variable.unit)}"
        for variable in ended
    ]
    count = sum(variable.optimised for variable in results.variables)
    return Finding(
        f"{len(ended)} of {counted(count, 'variable')} at a limit",
        f"The winner has its {' and its '.join(parts)}. A better body may lie beyond. If it can be made, widen the "
        "range: of a dimension in the robot's design space, then fit its surrogate anew; of an option under ranges.",
    )


def _alternatives(snapshot: StudySnapshot, results: StudyResults) -> Finding | None:
    """Return the finalists whose mean distance on FEM is about that of the winner, and how their bodies differ."""
    assert results.winner is not None
    if not _is_about_distance(snapshot):
        return None
    agent = results.winner.agents[0]
    tests = {group.key: group.mean.mean_distance for group in snapshot.unseen_tests}
    own = tests.get((results.winner.trial, agent, "fem"))
    if own is None:
        return None
    variables = [variable for variable in results.variables if variable.optimised]
    winner = {**results.winner.design, **results.winner.options}
    parts = []
    for body in results.finalists:
        distance = tests.get((body.trial, agent, "fem"))
        if body.trial == results.winner.trial or distance is None:
            continue
        if distance - own > NEGLIGIBLE * results.success_distance:
            continue
        values = {**body.design, **body.options}
        steps = [abs(v.place(values[v.name]) - v.place(winner[v.name])) for v in variables]
        far = variables[int(np.argmax(steps))]
        differs = f"{far.name.replace('_', ' ')} {present(values[far.name], far.unit)}"
        ends = snapshot.config.distance.text(distance)
        parts.append(f"Trial {body.trial} ({ends}, {differs} instead of {present(winner[far.name], far.unit)})")
    if not parts:
        return None
    return Finding(
        "Other bodies do as well", f"{'. '.join(parts)}. Choose the one that is easiest to make.", warns=False
    )
