"""One page about a fit or a comparison with measurements: sentences, tables and pictures in one HTML file."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from softgym_envs.extensions.design.measurements import Measurements
from softgym_envs.extensions.design.plots import BASELINE, OTHER, STYLE, WINNER
from softgym_envs.extensions.design.records import CalibrationResult
from softgym_envs.storage import atomic_write
from softgym_envs.units import display


@dataclass(frozen=True)
class Table:
    """A table of texts; numbers are right-aligned."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""


@dataclass(frozen=True)
class Picture:
    """A picture with what it shows."""

    title: str
    png: bytes
    caption: str = ""


@dataclass(frozen=True)
class Page:
    """What a page says: a title, sentences, tables and pictures in their order."""

    title: str
    sentences: Sequence[str]
    parts: Sequence[Table | Picture] = field(default_factory=list)


CSS = """
body { font: 16px/1.5 system-ui, sans-serif; color: #1c2430; max-width: 62rem; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.7rem; line-height: 1.25; } h2 { font-size: 1.15rem; margin: 2rem 0 .4rem; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; } .wide { overflow-x: auto; }
th, td { padding: .25rem .8rem .25rem 0; text-align: left; border-bottom: 1px solid #dfe3e8; }
th { font-weight: 600; } td.number { text-align: right; } p.note, figcaption { color: #55606e; font-size: .9rem; }
figure { margin: 0; } img { max-width: 100%; height: auto; }
"""


def write_page(path: str | Path, page: Page) -> None:
    """Write a page as one self-contained HTML file."""
    parts = [f"<h1>{html.escape(page.title)}</h1>"]
    parts += [f"<p>{html.escape(sentence)}</p>" for sentence in page.sentences]
    for part in page.parts:
        parts.append(f"<h2>{html.escape(part.title)}</h2>")
        parts.append(_table(part) if isinstance(part, Table) else _picture(part))
    text = (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width">'
        f"<title>{html.escape(page.title)}</title><style>{CSS}</style></head>\n<body>\n"
    )
    with atomic_write(path, "w") as stream:
        stream.write(text + "\n".join(parts) + "\n</body></html>\n")


def _table(table: Table) -> str:
    def cell(text: str) -> str:
        number = text[:1].isdigit() or (text[:1] in "-+" and text[1:2].isdigit())
        return f'<td class="number">{html.escape(text)}</td>' if number else f"<td>{html.escape(text)}</td>"

    head = "".join(f'<th scope="col">{html.escape(name)}</th>' for name in table.columns)
    body = "\n".join("<tr>" + "".join(cell(text) for text in row) + "</tr>" for row in table.rows)
    note = f'<p class="note">{html.escape(table.note)}</p>' if table.note else ""
    return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>\n{body}\n</tbody></table></div>{note}'


def _picture(picture: Picture) -> str:
    data = base64.b64encode(picture.png).decode()
    caption = f"<figcaption>{html.escape(picture.caption)}</figcaption>" if picture.caption else ""
    alt = html.escape(picture.caption or picture.title, quote=True)
    return f'<figure><img alt="{alt}" src="data:image/png;base64,{data}">{caption}</figure>'


def drawn(draw: Any, columns: int = 1, *, width: float = 5.0, height: float = 3.8) -> bytes:
    """Return as PNG what a function draws on a list of axes side by side."""
    import matplotlib

    with matplotlib.rc_context(STYLE):
        from matplotlib.figure import Figure

        figure = Figure(figsize=(columns * width, height), dpi=110, layout="constrained")
        draw(list(np.atleast_1d(figure.subplots(1, columns))))
        stream = io.BytesIO()
        figure.savefig(stream, format="png")
    return stream.getvalue()


def parameter_table(result: CalibrationResult, units: dict[str, str]) -> Table:
    """Return the fitted parameters with their intervals, in the units of reports.

    Args:
        result: of a calibration.
        units: SI unit of each parameter by name, in the order of the rows.
    """
    rows = []
    found = {**result.design, **result.nuisances}
    for name, si in units.items():
        unit, scale, _ = display(si)
        ends = (result.intervals or {}).get(name)
        interval = "" if ends is None else f"{scale * ends[0]:.4g} to {scale * ends[1]:.4g}"
        bound = "at its bound" if name in result.at_bound else ""
        rows.append([name, f"{scale * found[name]:.4g}", interval, unit, bound])
    level = f"{100 * (result.level or 0.0):g} % interval"
    return Table("What was fitted", ["parameter", "value", level, "unit", ""], rows, " ".join(result.notes))


def calibration_page(
    name: str,
    result: CalibrationResult,
    units: dict[str, str],
    parts: Sequence[tuple[str, Measurements, np.ndarray]],
) -> Page:
    """Return the page of a calibration.

    Args:
        name: of the calibration.
        result: what was found.
        units: SI unit of each fitted parameter by name.
        parts: title, measured states and predicted readings (N, n_a + n_e) of the fitted and the held-out trials.
    """
    rows = []
    for kind, fitted in result.errors.items():
        unit, scale, _ = display("m" if kind == "effector" else "N")
        held = result.held_out_errors.get(kind)
        row = [f"{kind} [{unit}]", f"{scale * fitted:.3g}"]
        rows.append([*row, *(["none", ""] if held is None else [f"{scale * held:.3g}", f"{held / fitted:.2f}"])])
    states = f"{result.measured_states} states fitted, {result.held_out_states} held out."
    sentences = [states, *(result.notes or ["Every parameter is determined by these data."])]
    contents: list[Table | Picture] = [
        Table("Root mean square errors per coordinate", ["measured", "fitted", "held out", "ratio"], rows),
        parameter_table(result, units),
    ]
    if result.correlations is not None and len(result.correlations) > 1:
        contents.append(_correlations(result.correlations))
    measured = [(title, data, readings) for title, data, readings in parts if not np.isnan(data.effector).all()]
    contents += [residual_picture(title, data, readings) for title, data, readings in measured]
    return Page(f"Calibration {name}", sentences, contents)


def _correlations(table: dict[str, dict[str, float]]) -> Picture:
    names = list(table)
    values = np.array([[table[a][b] for b in names] for a in names])

    def draw(axes: list[Any]) -> None:
        shown = axes[0].imshow(values, vmin=-1.0, vmax=1.0, cmap="RdBu_r")
        axes[0].set_xticks(range(len(names)), names, rotation=60, ha="right")
        axes[0].set_yticks(range(len(names)), names)
        axes[0].grid(False)
        axes[0].figure.colorbar(shown, ax=axes[0], shrink=0.8)

    size = 3.0 + 0.3 * len(names)
    return Picture("Correlation of the errors of the parameters", drawn(draw, width=size + 0.8, height=size))


def residual_picture(title: str, data: Measurements, readings: np.ndarray) -> Picture:
    """Return the distance of predicted from measured effectors of each state, in the order of the recording."""
    n = data.effort.shape[1]
    error = (readings[:, n:] - data.effector).reshape(len(data), -1, 3)
    away = 1e3 * np.linalg.norm(error, axis=2)

    def draw(axes: list[Any]) -> None:
        for k in range(away.shape[1]):
            color = (WINNER, BASELINE, OTHER)[k] if away.shape[1] <= 3 else None
            axes[0].plot(np.arange(1, len(away) + 1), away[:, k], ".", ms=4, color=color, label=f"effector {k + 1}")
        axes[0].set_xlabel("state")
        axes[0].set_ylabel("distance of the prediction [mm]")
        axes[0].set_ylim(bottom=0.0)
        if away.shape[1] > 1:
            axes[0].legend()

    caption = f"mean {np.nanmean(away):.2f} mm, largest {np.nanmax(away):.2f} mm"
    return Picture(f"Residuals: {title}", drawn(draw, width=8.0, height=3.2), caption)
