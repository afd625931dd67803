"""The report of a study: one self-contained HTML file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import yaml
from markupsafe import Markup

from softgym_envs.codesign.result_files import write_results
from softgym_envs.codesign.results import StudyResults
from softgym_envs.codesign.snapshot import StudySnapshot, load_study
from softgym_envs.errors import SoftGymError
from softgym_envs.extensions.report import figures, motion, sentences, tables
from softgym_envs.extensions.report.episodes import Episode, run_episodes
from softgym_envs.extensions.report.exports import Download, write_exports
from softgym_envs.extensions.report.findings import Finding, findings
from softgym_envs.extensions.report.pictures import BodyPictures, body_pictures
from softgym_envs.extensions.report.sentences import KeyFigure
from softgym_envs.registry import Table
from softgym_envs.storage import atomic_write
from softgym_envs.wording import counted

if TYPE_CHECKING:
    from plotly.graph_objects import Figure


@dataclass(frozen=True)
class GoalSection:
    """What baseline and winner reach; parts that are not known are empty.

    Attributes:
        count: number of test goals.
        radius: final distance up to which a goal is reached.
        legend: symbol, colour, meaning and number of each outcome of a goal.
        views: the goals from each side.
        motion: both bodies in motion.
        episode: what the motion shows.
        film: source of the film of the motion.
    """

    count: int
    radius: str
    legend: Sequence[tuple[str, str, str, int]]
    views: list[Markup]
    motion: Markup | str
    episode: str
    film: str


@dataclass(frozen=True)
class TestSection:
    """Baseline against winner on test goals; without rows, why there are none."""

    columns: list[str]
    rows: list[tables.ComparisonRow]
    efforts: list[tables.EffortRow]
    missing: str
    measure: str
    reached: Markup | None
    goals_note: str
    effort_note: str
    mesh_note: str
    interval_note: str


@dataclass(frozen=True)
class SearchSection:
    """Figures of the search by title, and notes below them."""

    figures: list[tuple[str, Markup]]
    notes: list[str]


@dataclass(frozen=True)
class TransferSection:
    """The finalists on surrogate and FEM."""

    rows: list[tables.TransferRow]
    figure: Markup | None
    columns: list[str]
    finalists: list[tables.FinalistRow]


@dataclass(frozen=True)
class ReportSection:
    """A section that an installed package adds to reports.

    Attributes:
        title: its heading.
        write: returns its HTML for a study; empty for a study that it has nothing to say about.
    """

    title: str
    write: Callable[[StudySnapshot, StudyResults], str]


SECTIONS = Table("section of the report", {}, group="softgym_envs.report_sections")
"""Sections of installed packages by name, each a `ReportSection`; they stand before the list of files."""


@dataclass(frozen=True)
class Page:
    """Everything that the template ``report.html.j2`` shows, in its order."""

    results: StudyResults
    plotly: Markup
    headline: str
    key_figures: list[KeyFigure]
    findings: list[Finding]
    question: list[tuple[str, str]]
    goals: GoalSection
    pictures: BodyPictures
    design: list[tables.DesignRow]
    test: TestSection
    search: SearchSection
    transfer: TransferSection
    cost: list[tables.CostRow]
    sections: list[tuple[str, Markup]]
    downloads: list[Download]
    not_written: list[str]
    rerun: list[tuple[str, str]]
    trial_columns: list[str]
    trials: list[tables.TrialRow]
    config: str
    end_colours: dict[str, str]


def write_report(folder: str | Path) -> Path:
    """Write ``report.html`` and the tables of results of a study, finished or not, and return the path of the report.

    Raises:
        DataError: if the folder holds no study, or a file of it is missing, damaged or edited.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    snapshot = load_study(folder)
    snapshot.folder.check_complete()
    page = _page(snapshot, write_results(snapshot))
    templates = FileSystemLoader(Path(__file__).parent / "templates")
    environment = Environment(
        loader=templates, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    path = snapshot.folder.path / "report.html"
    with atomic_write(path, "w") as stream:
        stream.write(environment.get_template("report.html.j2").render(vars(page), counted=counted))
    return path


def _page(snapshot: StudySnapshot, results: StudyResults) -> Page:
    config = snapshot.config
    episodes: Sequence[Episode] = []
    failed = []
    try:
        episodes = run_episodes(snapshot, results)
    except SoftGymError as error:  # the report is useful without them
        failed = [f"The episodes of baseline and winner cannot be shown: {error}"]
    downloads, missing = write_exports(snapshot, results, episodes)
    added = [(section.title, section.write(snapshot, results)) for section in SECTIONS.values()]
    trial_columns, trials = tables.trial_table(snapshot, results)
    return Page(
        results=results,
        plotly=Markup(figures.plotly_code()),
        headline=sentences.headline(snapshot, results),
        key_figures=sentences.key_figures(snapshot, results),
        findings=findings(snapshot, results),
        question=sentences.question(snapshot, results),
        goals=_goal_section(snapshot, results, episodes, downloads),
        pictures=body_pictures(snapshot, results),
        design=[tables.design_row(variable) for variable in results.variables],
        test=_test_section(snapshot, results),
        search=_search_section(snapshot, results),
        transfer=_transfer_section(snapshot, results),
        cost=tables.cost_rows(results.cost),
        sections=[(title, Markup(html)) for title, html in added if html],
        downloads=downloads,
        not_written=[*missing, *failed],
        rerun=sentences.rerun(snapshot, results),
        trial_columns=trial_columns,
        trials=trials,
        config=yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False),
        end_colours=figures.COLOURS,
    )


def _goal_section(
    snapshot: StudySnapshot, results: StudyResults, episodes: Sequence[Episode], downloads: Sequence[Download]
) -> GoalSection:
    outcomes = motion.goal_outcomes(snapshot, results)
    views = [] if outcomes is None else motion.goal_views(outcomes)
    film = next((file for file in downloads if file.name.endswith(".gif")), None)
    return GoalSection(
        count=results.comparison[0].goals if results.comparison else 0,
        radius=snapshot.config.distance_scale.limit_text(results.success_distance),
        legend=[] if outcomes is None else outcomes.legend,
        views=[Markup(figures.html(figure, f"goals-{plane}")) for plane, figure in views],
        motion=Markup(figures.html(motion.motion(episodes, outcomes), "motion")) if episodes else "",
        episode=sentences.episode_text(episodes),
        film="" if film is None else film.href.replace("data:application/octet-stream", "data:image/gif"),
    )


def _test_section(snapshot: StudySnapshot, results: StudyResults) -> TestSection:
    config = snapshot.config
    return TestSection(
        columns=tables.comparison_columns(config),
        rows=[tables.comparison_row(row, config) for row in results.comparison],
        efforts=tables.effort_rows(results.comparison, config.effort),
        missing=results.no_winner or sentences.why_untested(snapshot, results),
        measure=config.distance.label.lower(),
        reached=_html(figures.reached(snapshot, results), "reached"),
        goals_note=sentences.goals_note(snapshot),
        effort_note=sentences.effort_note(snapshot),
        mesh_note=sentences.mesh_note(snapshot, results),
        interval_note=sentences.interval_note(snapshot, results),
    )


def _search_section(snapshot: StudySnapshot, results: StudyResults) -> SearchSection:
    notes = sentences.search_notes(snapshot, results)
    if not any(trial.state == "complete" for trial in snapshot.trials):
        return SearchSection([], notes)
    found = figures.search_figures(snapshot, results)
    drawn = [(title, Markup(figures.html(figure, f"search-{k}"))) for k, (title, figure) in enumerate(found)]
    return SearchSection(drawn, notes)


def _transfer_section(snapshot: StudySnapshot, results: StudyResults) -> TransferSection:
    measures = snapshot.config.shown_objectives
    rows = [tables.transfer_row(row, measures[row.objective]) for row in results.transfer]
    figure = _html(figures.transfer(snapshot, results), "transfer")
    return TransferSection(rows, figure, *tables.finalist_table(snapshot, results))


def _html(figure: Figure | None, name: str) -> Markup | None:
    return None if figure is None else Markup(figures.html(figure, name))
