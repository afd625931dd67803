"""Numbers in text: small values keep two digits, counts agree with their nouns."""

import ast
import re
from pathlib import Path

import pytest

from softgym_envs.codesign.metrics.metric import find_metric
from softgym_envs.envs.tasks.base import LENGTHS
from softgym_envs.envs.tasks.reach import Reach
from softgym_envs.wording import counted, decimal

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize(
    "value, decimals, sign, text",
    [
        (12.346, 2, "", "12.35"),
        (0.151, 2, "", "0.15"),
        (0.0996, 2, "", "0.10"),
        (0.0283, 2, "", "0.028"),
        (0.0249, 2, "", "0.025"),
        (-0.0283, 2, "+", "-0.028"),
        (0.00041, 2, "+", "+0.00041"),
        (3.4, 0, "", "3.4"),
        (420.0, 0, "", "420"),
        (3.2e-9, 2, "", "3.2e-09"),
        (0.0, 2, "", "0.00"),
        (-2e-16, 1, "+", "+0.0"),
        (float("nan"), 2, "", "nan"),
    ],
)
def test_small_numbers_keep_two_digits(value, decimals, sign, text):
    assert decimal(value, decimals, sign) == text


def test_two_small_distances_are_told_apart():
    measure = find_metric("mean_distance", task=Reach)
    assert [measure.text(value) for value in (2.8e-5, 2.5e-5)] == ["0.028 mm", "0.025 mm"]
    assert [LENGTHS.text(value) for value in (2.8e-5, 3.2e-3)] == ["0.028 mm", "3.2 mm"]


def test_counts():
    assert [counted(1, noun) for noun in ("test goal", "body")] == ["1 test goal", "1 body"]
    found = [counted(n, noun) for n, noun in ((0, "test goal"), (2, "body"), (3, "process"))]
    assert found == ["0 test goals", "2 bodies", "3 processes"]


def test_texts_of_studies_count_with_their_helper():
    """A count before a plural noun in an f-string is right for every number but one."""
    nouns = "goals|bodies|trials|tests|finalists|policies|designs|workers|episodes|winners"
    found = []
    folders = ROOT / "softgym_envs/extensions/report", ROOT / "softgym_envs/cli"
    for path in sorted(file for folder in folders for file in folder.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.JoinedStr):
                for value, text in zip(node.values, node.values[1:], strict=False):
                    if isinstance(value, ast.FormattedValue) and isinstance(text, ast.Constant):
                        match = re.match(rf" ([a-z]+ )?({nouns})\b", str(text.value))
                        if match:
                            found.append(f"{path.name}:{node.lineno} {ast.unparse(value)}{match[0]}")
    assert [each for each in found if "MIN_GOALS" not in each] == []
