"""Damaged and edited files of a study: each is noticed, by the report and when the study continues."""

from __future__ import annotations

import json
import shutil

import pytest

from softgym_envs.codesign.config import StudyConfig
from softgym_envs.codesign.folder import StudyFolder
from softgym_envs.codesign.result_files import write_results
from softgym_envs.codesign.snapshot import load_study
from softgym_envs.codesign.study import run_study
from softgym_envs.errors import SoftGymError
from softgym_envs.extensions.report.page import write_report
from softgym_envs.storage import write_signed

TRIALS = 3
TEST = "finalists/trial0000-qp-surrogate-unseen.json"
SCREEN = "screen/000.json"


@pytest.fixture(scope="module")
def whole(tmp_path_factory, tiny):
    """A finished study of three bodies that were scored, of which two were tested."""
    data = tiny(
        trials=TRIALS,
        goals={"count": 2, "unseen_count": 2, "training_count": 1},
        screen={"enabled": True, "candidates": 2, "keep": 0.5, "goals": 1},
        finalists={"count": 1},
    )
    folder = tmp_path_factory.mktemp("whole") / "study"
    run_study(StudyConfig.model_validate(data), folder, progress=False)
    return folder


def result(number):
    return f"trials/{number:04d}/result.json"


def edit(name, change):
    """Change a JSON file without its hash."""

    def damage(folder):
        data = json.loads((folder / name).read_text())
        change(data)
        (folder / name).write_text(json.dumps(data))

    return damage


def forge(name, change):
    """Change a JSON file and its hash: only what other files say of it is left to notice."""

    def damage(folder):
        data = json.loads((folder / name).read_text())
        change(data)
        write_signed(folder / name, data)

    return damage


def text(name, *replacements):
    def damage(folder):
        content = (folder / name).read_text()
        for old, new in replacements:
            assert old in content
            content = content.replace(old, new)
        (folder / name).write_text(content)

    return damage


def cut(name, share=0.5):
    def damage(folder):
        content = (folder / name).read_bytes()
        (folder / name).write_bytes(content[: int(share * len(content))])

    return damage


def remove(name):
    return lambda folder: (folder / name).unlink()


def swap(one, other):
    def damage(folder):
        first, second = (folder / one).read_bytes(), (folder / other).read_bytes()
        (folder / one).write_bytes(second)
        (folder / other).write_bytes(first)

    return damage


def copy(one, other):
    def damage(folder):
        (folder / other).parent.mkdir(exist_ok=True)
        shutil.copy(folder / one, folder / other)

    return damage


def journal(change):
    """Change the list of records of the journal."""

    def damage(folder):
        path = folder / "journal.log"
        records = [json.loads(line) for line in path.read_text().splitlines()]
        path.write_text("".join(f"{json.dumps(record)}\n" for record in change(records)))

    return damage


def ends(records):
    """Return the places of the records that give a trial its scores."""
    return [place for place, record in enumerate(records) if record.get("values")]


def journal_score(records):
    records[ends(records)[1]]["values"][0] += 1e-3
    return records


def journal_body(records):
    next(record for record in records if "param_value_internal" in record)["param_value_internal"] *= 1.001
    return records


def of_another_study(name):
    """Take a file, with a right hash, from a study that minimises the effort and has other goals."""

    def damage(folder):
        config = StudyFolder(folder).config.model_dump()
        config |= {"objective": "mean_effort", "goals": {**config["goals"], "seed": 5}}
        other = StudyFolder.create(folder.parent / "other", StudyConfig.model_validate(config))
        shutil.copy(other.path / name, folder / name)

    return damage


def scored(data):
    data["scores"][0] += 1e-3


def moved(data):
    data["selection"][0][0][0] += 1e-3


DAMAGE = {
    "objective edited": ("config.yaml", text("config.yaml", ("objective: mean_distance", "objective: mean_effort"))),
    "range edited": ("config.yaml", text("config.yaml", ("count: 2", "count: 3"))),
    "configuration cut off": ("config.yaml", cut("config.yaml")),
    "configuration no YAML": ("config.yaml", text("config.yaml", ("environment:", "environment: [ {"))),
    "configuration binary": ("config.yaml", lambda folder: (folder / "config.yaml").write_bytes(b"\xff\x00\xfe")),
    "configuration removed": ("config.yaml", remove("config.yaml")),
    "configuration of another study": ("config.yaml", of_another_study("config.yaml")),
    "goal edited": ("goals.json", edit("goals.json", moved)),
    "goal and hash edited": ("goals.json", forge("goals.json", moved)),
    "goals cut off": ("goals.json", cut("goals.json")),
    "goals empty": ("goals.json", cut("goals.json", 0.0)),
    "goals removed": ("goals.json", remove("goals.json")),
    "goals of another study": ("goals.json", of_another_study("goals.json")),
    "score edited": (result(1), edit(result(1), scored)),
    "score and hash edited": (result(1), forge(result(1), scored)),
    "score not a number": (result(1), edit(result(1), lambda data: data.update(scores=[float("nan")]))),
    "value edited": (result(1), forge(result(1), lambda data: data["values"].update(mean_distance=1e-6))),
    "design edited": (result(1), forge(result(1), lambda data: data["design"].update(height=0.0211))),
    "seed edited": (result(2), forge(result(2), lambda data: data.update(sampler_seed=99))),
    "origin edited": (result(1), forge(result(1), lambda data: data.update(origin="baseline"))),
    "state edited": (result(1), forge(result(1), lambda data: data.update(state="pruned", scores=[]))),
    "field removed": (result(1), forge(result(1), lambda data: data.pop("origin"))),
    "result cut off": (result(1), cut(result(1))),
    "result removed": (result(1), remove(result(1))),
    "results swapped": (result(1), swap(result(1), result(2))),
    "result copied": (result(7), copy(result(1), result(7))),
    "result invented": (result(7), forge(result(7), lambda data: data.update(number=7))),
    "result a list": (result(1), lambda folder: (folder / result(1)).write_text("[1, 2]")),
    "screen edited": (SCREEN, edit(SCREEN, lambda data: data.update(scores=[0.0]))),
    "screen swapped": (SCREEN, swap(SCREEN, "screen/001.json")),
    "test edited": (TEST, edit(TEST, lambda data: data["values"].update(mean_distance=1e-6))),
    "test cut off": (TEST, cut(TEST)),
    "account edited": ("account.json", edit("account.json", lambda data: data.update(wall_seconds={}))),
    "provenance edited": (
        "provenance.json",
        edit("provenance.json", lambda data: data["versions"].update({"softgym-envs": "0.0.1"})),
    ),
    "provenance removed": ("provenance.json", remove("provenance.json")),
    "journal removed": ("journal.log", remove("journal.log")),
    "journal empty": ("journal.log", cut("journal.log", 0.0)),
    "journal cut in half": ("journal.log", cut("journal.log")),
    "journal cut within a line": ("journal.log", text("journal.log", ('"values":[', '"val'))),
    "journal score edited": ("journal.log", journal(journal_score)),
    "journal body edited": ("journal.log", journal(journal_body)),
    "journal trial removed": (
        "journal.log",
        journal(lambda records: [r for r in records if r["op_code"] != 4 or records.index(r) > ends(records)[0]]),
    ),
    "journal binary": ("journal.log", lambda folder: (folder / "journal.log").write_bytes(b"\xff\x00\n\xfe\n")),
}
"""What is done to a study, and the file that the message must name."""


def test_a_whole_study_is_accepted(whole):
    before = {path: path.read_bytes() for path in whole.rglob("*.json")}
    snapshot = load_study(whole)
    assert len(snapshot.trials) == TRIALS and len(snapshot.all_tests) == 4
    assert before == {path: path.read_bytes() for path in whole.rglob("*.json")}


@pytest.mark.parametrize("kind", DAMAGE)
def test_damage_is_noticed(kind, whole, tmp_path):
    folder = tmp_path / "study"
    shutil.copytree(whole, folder)
    config = StudyFolder(folder).config
    named, damage = DAMAGE[kind]
    if kind == "result invented":
        copy(result(1), named)(folder)
    damage(folder)
    for use in (lambda: write_report(folder), lambda: run_study(config, folder, progress=False)):
        with pytest.raises(SoftGymError) as caught:
            use()
        message = str(caught.value)
        assert (named in message or f"folder '{folder}'" in message) and "\n" not in message
        assert "restore it from a copy" in message or "another folder" in message or "elsewhere" in message


@pytest.mark.parametrize(
    "damage",
    [
        cut("journal.log", 0.999),
        journal(lambda records: [*records, records[-1]]),
        lambda folder: (folder / "results.json").write_text("{}"),
        lambda folder: (folder / "trials.csv").write_text("trial,score\n0,1e9\n"),
    ],
    ids=["last line cut off", "last line twice", "results edited", "table edited"],
)
def test_what_is_known_elsewhere_is_mended(damage, whole, tmp_path):
    """The journal is also cut off when a process is killed while it writes; results are written anew."""
    folder = tmp_path / "study"
    shutil.copytree(whole, folder)

    def written():
        write_results(load_study(folder))
        results = json.loads((folder / "results.json").read_text())
        del results["provenance"]  # has the time
        return results, (folder / "trials.csv").read_bytes()

    before = written()
    damage(folder)
    assert written() == before
