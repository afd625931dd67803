"""Tables of the documentation, made from the recorded results by `benchmarks.page`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from benchmarks.learners import REPORTS, SCORES, TASKS, spread
from benchmarks.recorded import figure, number, records, results
from benchmarks.studies import JUDGES
from softgym_envs.agents.results import LEARNERS, MODEL_BASED
from softgym_envs.wording import decimal

WEIGHTS = {
    "finger_1cable": "finger, 1 cable",
    "finger_2cables": "finger, 2 cables",
    "press_finger": "press finger",
    "diamond": "Diamond",
    "three_finger_gripper": "three-finger gripper",
    "two_finger_gripper": "two-finger gripper",
    "trunk": "Stiff-Flop trunk",
    "cable_trunk": "cable trunk",
    "contact_finger": "contact finger",
}
"""Readable names of the robots, by name of the shipped weights."""

HEADLINES = ("finger_reach", "diamond_reach", "trunk_reach", "cable_trunk_reach", "tetrapod_reach")


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]], align: str = "") -> str:
    """Return a Markdown table; ``align`` has one of ``l`` and ``r`` for each column, default ``l``."""
    rules = ["--:" if side == "r" else "---" for side in align.ljust(len(head), "l")]
    return "\n".join(f"| {' | '.join(str(cell) for cell in row)} |" for row in (head, rules, *rows))


def named(benchmark: str, *columns: tuple[str, str], names: Iterable[str] = WEIGHTS) -> list[list[str]]:
    """Return a row for each robot that has results: its name, then one figure for each (result, format)."""
    found = results(benchmark)
    return [
        [WEIGHTS[name], *(figure(benchmark, f"{name}: {result}", form) for result, form in columns)]
        for name in names
        if f"{name}: {columns[0][0]}" in found
    ]


def short(value: float) -> str:
    """Write two significant digits, or three from 1 on."""
    return number(value, "#.2g") if abs(value) < 1.0 else f"{value:.3g}"


# -- co-design ------------------------------------------------------------------------------------------------------


def headlines() -> str:
    """Studies: mean distance to the test goals on FEM, from the baseline to the winner, and on a finer mesh."""
    rows = []
    for key in HEADLINES:
        study = results("codesign")[key]
        row = study["rows"][0]
        name = f"{study['title']}; {row['controller'].partition(',')[0]}"
        finer = next((r for r in study.get("meshes", ()) if r["judge"] == JUDGES["refined"]), None)
        same = None if finer is None else (finer["change before [mm]"], finer["change [mm]"])
        checked = "" if same is None else "{}\u00a0→\u00a0{}\u00a0mm".format(*(decimal(x, 2) for x in same))
        interval = _interval(row) or ()
        change = "{:.1f}\u00a0to\u00a0{:.1f}\u00a0mm".format(*interval)
        rows.append([name, *_ends(row), change, checked, f"`{study['command']}`"])
    head = ["robot; controller", "baseline", "winner", "change, 95%", "study's → finer mesh", "command"]
    return markdown(head, rows, "lrrrrl")


def _interval(row: dict[str, Any]) -> list[float] | None:
    """Interval of the change [mm], with what is left of the mesh's error if a study asked a finer mesh."""
    return row.get("change with the mesh, 95% interval [mm]") or row.get("change, 95% interval [mm]")


def _ends(row: dict[str, Any]) -> list[str]:
    # No-break spaces keep numbers and units together.
    before, after = (decimal(row[f"{who} [mm]"], 2) for who in ("baseline", "winner"))
    return [f"{before}\u00a0mm", f"→\u00a0{after}\u00a0mm"]


def codesign() -> str:
    """All studies: mean distances and the intervals of their change."""
    rows = []
    for study in results("codesign").values():
        for index, row in enumerate(study["rows"]):
            interval = _interval(row)  # None for a single path
            name = "" if index else study["title"]
            change = "" if interval is None else "{:.1f} to {:.1f} mm".format(*interval)
            rows.append([name, row["controller"], *_ends(row), change])
    return markdown(["robot", "controller", "baseline", "winner", "95% interval of the change"], rows, "llrrr")


def codesign_goals() -> str:
    """All studies: goals reached and CPU time."""
    rows = []
    for study in results("codesign").values():
        for index, row in enumerate(study["rows"]):
            shares = [row.get(f"goals reached by the {who} [%]") for who in ("baseline", "winner")]
            reached = ["" if shares[0] is None else f"{shares[0]:g}%", "" if shares[1] is None else f"→ {shares[1]:g}%"]
            time = row.get("CPU with FEM check [min]")
            cells = [row["controller"], *reached, str(row["test goals"]), f"{time:.1f} min" if time else ""]
            rows.append(["" if index else study["title"], *cells])
    head = ["robot", "controller", "goals reached, baseline", "winner", "test goals", "CPU time, FEM check included"]
    return markdown(head, rows, "llrrrr")


def codesign_bodies() -> str:
    """What the winners look like."""
    studies = results("codesign").values()
    return markdown(
        ["robot", "dimensions, baseline → winner", "command"],
        [[s["title"], s["rows"][0].get("winner's body", ""), f"`{s['command']}`"] for s in studies],
    )


STRATEGIES = (
    "warm start, analytic gradient, Gaussian process, 12 goals (default)",
    "shared policy, Gaussian process, 12 goals",
    "inverse QP, Gaussian process, 12 goals",
    "critic",
    "distribution",
    "plain nesting, Hyperband",
)
"""Runs of the short table: the best of each strategy."""


def strategies() -> str:
    """Regret and cost of the co-design strategies."""
    columns = {
        "regret at the end [%]": "regret at the end [%]",
        "environment steps": "environment steps",
        "steps behind the policy it is given": "steps of the given policy",
        "environment steps to 10% regret": "steps until regret stays below 10%",
        "environment steps to 1% regret": "below 1%",
        "CPU seconds to 1% regret": "CPU seconds until then",
        "CPU minutes": "CPU [min]",
    }
    end = ": regret at the end [%]"
    return _regrets([name.removesuffix(end) for name in results("strategies") if name.endswith(end)], columns)


def strategies_short() -> str:
    """Regret and cost of one run of each strategy."""
    columns = {
        "regret at the end [%]": "regret at the end [%]",
        "CPU seconds to 1% regret": "CPU seconds until regret stays below 1%",
        "environment steps to 1% regret": "environment steps until then",
        "steps behind the policy it is given": "steps of the given policy",
    }
    return _regrets(STRATEGIES, columns)


def _regrets(names: Sequence[str], columns: Mapping[str, str]) -> str:
    found = results("strategies")
    rows = [[name, *(_spread(found[f"{name}: {column}"]) for column in columns)] for name in names]
    return markdown(["strategy", *columns.values()], rows, "l" + "r" * len(columns))


def _spread(value: object) -> str:
    """Write ``median (smallest to largest)``, or only the value if there is no spread."""
    if not isinstance(value, str):
        return f"{value:,}"
    text = value.replace("inf", "not reached").replace(" (one repeat)", "")
    middle, _, rest = text.partition(" (")
    low, _, high = rest.rstrip(")").partition(" to ")
    return middle if low == high == middle else text


def learners() -> str:
    """CPU seconds of the learners to 90 and 95 % of unseen goals, and their success on FEM."""
    found = results("learners")
    columns = ["CPU seconds to 90 %", "CPU seconds to 95 %", "CPU seconds of the training"]
    head = [*columns, "score on the surrogate [%]", "score on FEM [%]"]
    rows = []
    for task in TASKS:
        score = SCORES["_track" in task]
        shown = [*columns, *(score.format(place) for place in ("the surrogate", "FEM"))]
        for learner in REPORTS:
            name, kind = f"{task}, {learner}", "model-based" if learner in MODEL_BASED else "model-free"
            known = [found.get(f"{name}: {column}", []) for column in shown]
            if name in found or known[0]:
                cells = [spread(values) if values else "not run" for values in known]
                rows.append([task, f"{LEARNERS[learner]} ({kind})", str(len(known[0])), *cells])
    return markdown(["task", "learner", "seeds", *head], rows, "llrrrrrr")


def kills() -> str:
    """Studies whose processes are killed."""
    rows = []
    for storage, title in (("journal", "journal in a folder"), ("postgresql", "PostgreSQL")):

        def value(name: str, storage: str = storage) -> str:
            return figure("codesign_kills", f"{storage}: {name}")

        killed, restarts = value("kills, restarts of the server").split(", ")
        kept, lost = value("finished trials kept once, lost or twice").split(", ")
        rerun = value("trials under way that were killed and ran again")
        rows.append([title, killed, restarts, kept, lost, rerun])
    head = ["storage", "kills of all processes", "restarts of the server", "finished trials kept exactly once"]
    return markdown([*head, "lost or duplicated", "interrupted trials that ran again"], rows, "lrrrrr")


def profile() -> str:
    """How the time of a study is spent."""
    found = results("codesign_profile")
    shares = {k[len("share of ") : -4]: v for k, v in found.items() if k.startswith("share of ")}
    return markdown(["part", "share of the time"], [[k, f"{v:.1f}%"] for k, v in shares.items()], "lr")


# -- policies -------------------------------------------------------------------------------------------------------


def agents() -> str:
    """Policies and baselines on unseen goals, from the stored runs."""
    from softgym_envs.agents.results import load_runs, table

    return table(load_runs()).replace("\n## ", "\n### ").strip()


def carry() -> str:
    """How far to the right the Tetrapod moves, by controller and mesh."""
    found: dict[str, dict[str, list[str]]] = {}
    for key, value in results("carry").items():
        mesh, _, name = key.partition(":")[0].split(", ", 2)
        farthest, last, _, folded = value.split(", ")
        found.setdefault(name, {}).setdefault(mesh, []).extend([farthest, last, folded])
    rows = [
        [name if k == 0 else "", mesh, *cells]
        for name, meshes in found.items()
        for k, (mesh, cells) in enumerate(meshes.items())
    ]
    head = ["controller", "mesh", "no payload: farthest [mm]", "end [mm]", "folded steps"]
    return markdown([*head, "1 kg: farthest [mm]", "end [mm]", "folded steps"], rows, "llrrrrrr")


# -- surrogates -----------------------------------------------------------------------------------------------------


def test_set() -> str:
    """Errors of the shipped weights on their test sets."""
    rows = named(
        "test_set",
        ("states for training / in the test set", ""),
        ("effector error, mean [mm]", ".2g"),
        ("effector error, worst [mm]", ".2g"),
        ("W, between actuators, relative error, median [%]", ".2g"),
        ("W, actuators to effector, relative error, median [%]", ".2g"),
        ("W, effector, relative error, median [%]", ".2g"),
    )
    for row in rows:
        row[1] = f"{int(row[1].partition(' /')[0]):,}"
    head = ["weights", "training states", "effector error, mean [mm]", "worst [mm]", "`W_aa`, median error [%]"]
    head += ["`W_ea` [%]", "`W_ee` [%]"]
    return markdown(head, rows, "lrrrrrr")


def buckling() -> str:
    """States about to buckle: how many there are, and how many the surrogate trusts."""
    found = results("test_set")
    rows = []
    for name, title in WEIGHTS.items():
        share = found[f"{name}: left out as about to buckle [% of the states]"]
        if share > 0.0:
            left = [f"{name}: left out: {what}" for what in ("effector error, mean [mm]", "effector error, worst [mm]")]
            trusted = next(v for k, v in found.items() if k.startswith(f"{name}: left out: trusted"))
            rows.append([title, f"{share:.2g}", *(f"{found[key]:.2g}" for key in left), f"{trusted:.0f}"])
    head = ["weights", "share of all states [%]", "effector error, mean [mm]", "worst [mm]", "trusted [%]"]
    return markdown(head, rows, "lrrrr")


def predicted_tracking() -> str:
    """Reference paths followed on the surrogate alone."""
    column = ("prediction to FEM, largest [mm]", "#.2g")
    return markdown(["weights", "largest distance [mm]"], named("predicted_tracking", column), "lr")


def trajectories() -> str:
    """Closing trajectory on the designs of the thesis."""
    rows = []
    for key, value in results("trajectories").items():
        if ": error" in key:
            case, _, published = key.partition(": error [%] (thesis ")
            rows.append([case, f"{value:.3f}", published.removesuffix(" %)")])
    return markdown(["design", "error [%]", "thesis [%]"], rows, "lrr")


def design_gradients() -> str:
    """Gradients in the design against differences of FEM."""
    rows = named(
        "design_gradients",
        ("bodies compared", ""),
        ("relative error, median [%]", ".1f"),
        ("relative error, three quarters are below [%]", ".1f"),
    )
    return markdown(["weights", "bodies", "median error [%]", "upper quartile [%]"], rows, "lrrr")


def networks() -> str:
    """Networks on the same data, by number of states."""
    found = results("networks")
    rows = []
    for key in found:
        if key.endswith(": effector error, mean [mm]"):
            stem = key.removesuffix(": effector error, mean [mm]")
            case, rest = stem.split(", ", 1)
            name, states = rest.rsplit(", ", 1)
            columns = ("effector error, mean [mm]", "loss as in the thesis", "W error, median [%]")
            cells = [_short_exponents(str(found[f"{stem}: {column}"])) for column in columns]
            seconds = f"{found[f'{stem}: training [CPU s]']:.0f}"
            rows.append([case, name, states.removesuffix(" states"), *cells, seconds])
    head = ["body", "network", "states", "effector error, mean [mm]", "loss as in the thesis", "`W`, median error [%]"]
    return markdown([*head, "training, CPU [s]"], rows, "llrrrrr")


def _short_exponents(text: str) -> str:
    return text.replace("e-0", "e-")


# -- design tools ---------------------------------------------------------------------------------------------------


def design_optima() -> str:
    """Optimal fingers by gradient and by TPE, beside those of the thesis."""
    rows = []
    for metric, unit, digits in (
        ("bending_angle", "rad", 4),
        ("contact_force", "N", 2),
        ("normal_force", "N", 2),
    ):
        found = {k.removeprefix(f"{metric}: "): v for k, v in results("design_optima").items() if k.startswith(metric)}

        def pair(values: list[float], unit: str = unit, digits: int = digits) -> str:
            return " / ".join(f"{value:.{digits}f}" for value in values) + f" {unit}"

        methods = [["gradient", found["gradient, design"], pair(found["gradient, surrogate and FEM"])]]
        for start in ("best", "worst"):
            values = found[f"TPE, {start} corner, surrogate and FEM"]
            methods.append([f"TPE, {start} start", found[f"TPE, 60 trials, {start} corner, design"], pair(values)])
        if "thesis, design" in found:
            on_fem = found["thesis' design on FEM"]
            methods.append(["thesis", found["thesis, design"], f"– / {on_fem:.{digits}f} {unit}"])
        seconds = [found["gradient, grid of 729 and all descents [s]"], found["TPE, all corners [s]"]]
        times = [f"{value:.1f} s" for value in seconds] + [""] * len(methods)
        for index, (name, design, value) in enumerate(methods):
            label = f"`{metric}`" if index == 0 else ""
            rows.append([label, name, " / ".join(f"{d:.1f}" for d in design), value, times[index]])
    head = ["metric", "method", "length / height / joint height [mm]", "surrogate / FEM", "time, all eight starts"]
    return markdown(head, rows, "lllrr")


# -- mechanics ------------------------------------------------------------------------------------------------------


def tracking() -> str:
    """Published paths followed by the inverse QP on FEM."""
    return _path_errors("tracking", "path")


def closed_loop() -> str:
    """Circle of the Stiff-Flop in a closed loop, on plants of another stiffness."""
    return _path_errors("closed_loop", "plant and loop")


def _path_errors(benchmark: str, head: str) -> str:
    rows = []
    for key, value in results(benchmark).items():
        if key.endswith(": largest error [mm]"):
            name = key.removesuffix(": largest error [mm]")
            mean = results(benchmark)[f"{name}: mean [mm]"]
            rows.append([name.replace(" %", "%"), short(value), short(mean)])
    return markdown([head, "largest error [mm]", "mean [mm]"], rows, "lrr")


def side_by_side() -> str:
    """The same problems in several codes."""
    rows = []
    for key, row in results("side_by_side").items():
        if key != "versions":
            error = "reference" if abs(row["error"]) < 1e-8 else f"{row['error']:.2g}"
            rows.append([*key.split(" | "), str(row["unknowns"]), error, f"{row['seconds']:.2g}"])
    table = markdown(["case", "code", "element", "mesh", "unknowns", "error", "CPU time [s]"], rows, "llllrrr")
    versions = results("side_by_side")["versions"].items()
    return f"{table}\n\nVersions: {', '.join(f'{code} {number}' for code, number in versions if number)}."


def design_networks() -> str:
    """The thesis' network and ours over the lengths of the finger."""
    found = results("design_networks")
    names = list(dict.fromkeys(key.partition(": ")[0] for key in found))
    rows = []
    for name in names:
        row = {key.removeprefix(f"{name}: "): value for key, value in found.items() if key.startswith(f"{name}: ")}
        errors = [value for key, value in row.items() if key.startswith("trajectory")]
        loss = f"{row['loss as in the thesis']:.2g}"
        effector = [f"{1e3 * row[key]:.2g}" for key in ("effector_mean", "effector_worst")]
        definite = f"{100.0 * row['positive_definite']:.3g}%"
        span = f"{min(errors):.2g} to {max(errors):.2g}%"
        rows.append(
            [name, f"{row['training states']:,}", f"{row['training, CPU [s]']:.0f}", loss, *effector, definite, span]
        )
    published = ["thesis, as published", "50,000", "", "0.13 (F), 0.19 (G)", "", "about 3", "", "1.03 to 7.02%"]
    head = ["network", "states", "training, CPU [s]", "loss", "effector error, mean [mm]", "worst [mm]"]
    return markdown([*head, "`W` positive definite", "closing trajectory"], [published, *rows], "lrrrrrrr")


def sensor_accuracy() -> str:
    """The published sensorized fingers on three meshes and at three Poisson's ratios, beside the thesis."""
    from benchmarks.sensor_finger import MEASURED, TABLE

    found = results("sensor_accuracy")
    cases: dict[str, Mapping[str, Sequence[float]]] = {"thesis, simulated": TABLE, "thesis, measured": MEASURED}
    for key, values in found.items():
        case, _, design = key.rpartition(": ")
        if design in TABLE:
            cases.setdefault(case.replace("nu", "ν"), {})
            cases[case.replace("nu", "ν")] = {**cases[case.replace("nu", "ν")], design: values}
    rows = []
    for case, row in cases.items():
        cells = [f"{row[name][0]:.1f} µL, {row[name][1]:.1f}°" if name in row else "" for name in TABLE]
        rows.append([case, *cells, f"{row['large'][0] / row['slim'][0]:.2f}"])
    return markdown(["mesh, Poisson's ratio", *TABLE, "volume, large / slim"], rows, "lrrrr")


def sensor_convergence() -> str:
    """Volume change of two sensorized fingers on finer and finer meshes."""
    rows = []
    for key, (nodes, change) in results("sensor_accuracy").items():
        if key.startswith("convergence, "):
            element, size, name = (
                key.removeprefix("convergence, ").removesuffix(" [nodes, uL]").replace(":", ",").split(", ")
            )
            rows.append([name, element, size, f"{nodes:,}", f"{change:.1f}"])
    rows.sort(key=lambda row: (row[0], row[1], int(row[3].replace(",", ""))))
    return markdown(["finger", "elements", "size away from the cavities", "nodes", "volume change [µL]"], rows, "lllrr")


def sealed_stiffness() -> str:
    """How much sealed air stiffens the sensorized finger."""
    keys = ("tension, open [N]", "tension, sealed [%]", "compliance of the tip along y, sealed [%]", "tip, sealed [mm]")
    rows = []
    for name, row in results("sealed_finger").items():
        if not name.startswith("estimate"):
            forms = (".1f", "+.1f", "+.1f", ".2f")
            cells = [format(row[key], form) for key, form in zip(keys, forms, strict=True)]
            rows.append([name, f"{row['pressure [kPa]']:.1f}", *cells])
    head = ["mesh", "pressure [kPa]", "tension, open [N]", "tension, sealed [%]"]
    return markdown([*head, "compliance of the tip along y, sealed [%]", "tip moved [mm]"], rows, "lrrrrr")


def estimates() -> str:
    """Accuracy, coverage and speed of the estimator on finite elements, beside what was wanted."""
    found = results("estimation")
    lines = {
        "touches": ("touches", ".0f", ""),
        "error of the tip, mean [% of the length]": ("tip error mean [% of length]", ".2f", "1"),
        "error of the tip, 95th percentile [% of the length]": ("tip error 95th [% of length]", ".2f", ""),
        "error of the tip, worst [% of the length]": ("tip error worst [% of length]", ".1f", ""),
        "error of the force, median [%]": ("force error median [%]", ".1f", "10"),
        "error of the force, mean [%]": ("force error mean [%]", ".1f", "10"),
        "touches whose force is claimed to 10 % [%]": ("force told to 10 % [% of touches]", ".0f", ""),
        "error of their force, mean [%]": ("force error of those, mean [%]", ".1f", "10"),
        "truth within 95 %: tip [% of touches]": ("coverage tip [%]", ".1f", "93 to 97"),
        "truth within 95 %: force [% of touches]": ("coverage force [%]", ".1f", "93 to 97"),
        "readings per CPU second without a new equilibrium": (
            "updates per CPU s without a new equilibrium",
            ".0f",
            "200",
        ),
        "readings per CPU second, touches being new": ("updates on finite elements per CPU s", ".0f", "200"),
    }
    rows = [
        [title, *(format(row[key], form) for row in found.values()), wanted]
        for title, (key, form, wanted) in lines.items()
    ]
    return markdown(["", *found, "wanted"], rows, "l" + "r" * (len(found) + 1))


def sealed_estimates() -> str:
    """Estimates from pressures of sealed cavities beside those from volumes of open ones."""
    found = {key.removeprefix("estimate, "): v for key, v in results("sealed_finger").items() if "estimate" in key}
    lines = {
        "error of the tip, mean [% of the length]": ("tip error mean [% of length]", ".2f"),
        "error of the tip, 95th percentile [% of the length]": ("tip error 95th [% of length]", ".2f"),
        "error of the force, median [%]": ("force error median [%]", ".1f"),
        "error of the force, mean [%]": ("force error mean [%]", ".1f"),
        "touches whose force is claimed to 10 % [%]": ("force told to 10 % [% of touches]", ".0f"),
        "truth within 95 %: tip [% of touches]": ("coverage tip [%]", ".1f"),
        "truth within 95 %: force [% of touches]": ("coverage force [%]", ".1f"),
    }
    rows = [[title, *(format(row[key], form) for row in found.values())] for title, (key, form) in lines.items()]
    return markdown(["", *found], rows, "l" + "r" * len(found))


def stiff_flop() -> str:
    """Rest compliance of the Stiff-Flop trunk."""
    rows = []
    for key, value in results("stiff_flop").items():
        if isinstance(value, str) and value.startswith("ours "):
            ours, published = value.removeprefix("ours ").split(", published ")
            published, difference = published.split(": ")
            entry, _, rest = key.partition(" ")
            rows.append([f"`{entry}` {rest}".strip(), published, ours, difference.replace(" %", "%")])
    return markdown(["entry", "published", "ours", "difference"], rows, "lrrr")


def validation() -> str:
    """Exact and published solutions on refined meshes."""
    rows = []
    for key, row in results("validation").items():
        order = "" if row["order"] is None else f"{row['order']:.1f}"
        values = [f"{row[name]:.6g}" for name in ("value", "reference")]
        rows.append([*key.split(" | "), str(row["unknowns"]), *values, f"{row['error']:.2g}", order])
    head = ["case", "element", "mesh", "unknowns", "value", "reference", "error", "order"]
    return markdown(head, rows, "lllrrrrr")


def contact() -> str:
    """Contact beside exact solutions."""
    rows = []
    for key, row in results("contact").items():
        values = [f"{row[name]:.5g}" for name in ("value", "reference")]
        rows.append([*key.split(" | "), *values, f"{row['error']:.2g}", f"{row['tolerance']:.2g}"])
    return markdown(["case", "setup", "value", "reference", "error", "tolerance"], rows, "llrrrr")


# -- speed ----------------------------------------------------------------------------------------------------------


def surrogate_speed() -> str:
    """Steps per second of the environments on surrogates."""
    found = results("surrogate_step")
    names = [key.removesuffix(", single: steps per second") for key in found if ", single: " in key]
    kinds = ("single", "1024 at once in 1 process(es)", "1024 at once in 2 process(es)")
    rows = [[n, *(f"{found[f'{n}, {kind}: steps per second']:,.0f}" for kind in kinds)] for n in names]
    return markdown(["environment", "one at a time", "1024 at once, one process", "two processes"], rows, "lrrr")


def gpu_speed() -> str:
    """Steps per second of the environments in torch, bodies given or drawn, by how a step is run."""
    found = results("gpu_step")
    labels = [key.removesuffix(": steps per second").split(", ") for key in found if ", " in key]
    modes = list(dict.fromkeys(mode for _, _, mode in labels))
    rows = []
    for name, bodies in dict.fromkeys((name, bodies) for name, bodies, _ in labels):
        speeds = [found.get(f"{name}, {bodies}, {mode}: steps per second") for mode in modes]
        cells = ["" if speed is None else f"{speed / 1e6:.1f}" for speed in speeds]
        rows.append([name.removesuffix("-v0"), bodies.removesuffix(" design"), *cells])
    return markdown(["environment", "design", *(f"{mode} [10⁶ steps/s]" for mode in modes)], rows, "llrrr")


def fem_speed() -> str:
    """Steps per second of the environments on FEM."""
    found = results("fem_speed")
    rows = []
    for key, value in found.items():
        if key.endswith("-v0: steps per second"):
            name = key.removesuffix(": steps per second")
            nodes, elements, _ = found[f"{name}: nodes, elements, equations"].split(", ")
            rows.append([name.removesuffix("-v0"), nodes, elements, f"{value:.{0 if value > 10.0 else 1}f}"])
    return markdown(["environment", "nodes", "elements", "steps per second"], rows, "lrrr")


def deployed() -> str:
    """Times of the exported C model."""
    rows = []
    for robot in ("finger", "trunk"):
        stem = f"{robot}, 5 member(s)"
        cells = [figure("deployed", f"{stem}: {name}", ".0f") for name in (
            "C state, -O3 -march=native [us]", "C condensed, -O3 -march=native [us]", "Python state, batch 1 [us]",
            "Python condensed, batch 1 [us]",
        )]  # fmt: skip
        loop = f"{results('deployed')[f'{stem}: Algorithm 2 in C as a whole [Hz]'] / 1e3:.0f}"
        rows.append([robot, *cells, loop])
    head = ["model, five members", "C: state [µs]", "C: state and `W` [µs]", "Python: state [µs]"]
    return markdown([*head, "Python: state and `W` [µs]", "control loop in C [kHz]"], rows, "lrrrrr")


def provenance() -> str:
    """Commit and command of every recorded result."""
    rows = []
    for name, entry in sorted(records().items()):
        command = entry.get("command", f"softgym bench {name}")
        rows.append([f"`{name}`", f"`{command}`", f"`{entry['commit'][:12]}`", entry.get("note", "")])
    return markdown(["result", "command", "commit", "note"], rows)


TABLES: dict[str, Callable[[], str]] = {
    function.__name__: function
    for function in (
        headlines, codesign, codesign_goals, codesign_bodies, learners, strategies, strategies_short, kills,
        profile, agents, carry,
        test_set, buckling, predicted_tracking, trajectories, design_gradients, networks,
        design_optima,
        tracking, closed_loop, design_networks, sensor_accuracy, sensor_convergence, sealed_stiffness,
        estimates, sealed_estimates, side_by_side, stiff_flop,
        validation, contact, surrogate_speed, gpu_speed, fem_speed, deployed, provenance,
    )
}  # fmt: skip
"""Tables by the name in a marked place."""
