"""The verb ``plot``, and a run on data that is held in memory, as pictures need it."""

from __future__ import annotations

import argparse
import io
from pathlib import Path
from typing import TYPE_CHECKING, Any

from obsynth.cli.arguments import output_file
from obsynth.cli.data_run import protect_inputs, run_in_memory, summary_of_run
from obsynth.cli.output import print_json
from obsynth.errors import SpecError

if TYPE_CHECKING:
    from obsynth.data.run import DataRun
    from obsynth.results.design import ObserverDesign

#: Formats of pictures, with the mark by which an older one may be replaced.
PICTURES = {".png": rb"\A\x89PNG", ".svg": rb"<svg", ".pdf": rb"\A%PDF"}
#: Dots per inch of a picture made of dots.
_RESOLUTION = 160


def run_plot(options: argparse.Namespace) -> int:
    """Run ``plot``: gain set and data in, a picture or a window out."""
    from obsynth.files.outputs import FileKind
    from obsynth.results.gain_sets import load

    target: Path | None = options.out
    if target is not None:
        suffix = target.suffix.lower()
        if suffix not in PICTURES:
            raise SpecError(f"{target} has an unknown suffix: use one of {', '.join(PICTURES)}.", path=str(target))
        protect_inputs(options)
        output_file(target, FileKind(f"a picture ({suffix})", PICTURES[suffix]), options)
    parts = [part.strip() for part in options.show.split(",") if part.strip()]
    design = load(options.gains)
    found, watched = run_in_memory(design, options)
    _draw(found, design, parts, target)
    if options.json:
        print_json({"command": "plot", "gains": str(options.gains), "file": None if target is None else str(target),
                    **found.as_dict()})  # fmt: skip
    elif not options.quiet:
        print(summary_of_run(found, watched))
        if target is not None:
            print(f"Written: {target}")
    return 0


def _draw(found: DataRun, design: ObserverDesign, parts: list[str], target: Path | None) -> None:
    from obsynth.files.outputs import write_atomically
    from obsynth.plotting.data import panel_count, plot_data

    if target is not None:
        from matplotlib.figure import Figure

        from obsynth.plotting.panels import PANEL_HEIGHT, WIDTH

        count = panel_count(found, parts)
        figure = Figure(figsize=(WIDTH, PANEL_HEIGHT * max(count, 1) + 0.6), layout="constrained")
        axes = list(figure.subplots(max(count, 1), 1, sharex=True, squeeze=False)[:, 0])
        plot_data(found, design=design, show=parts, axes=axes[:count])
        buffer = io.BytesIO()
        figure.savefig(buffer, format=target.suffix[1:].lower(), dpi=_RESOLUTION, metadata=_undated(target))
        write_atomically(target, buffer.getvalue())
        return
    import matplotlib as mpl
    import matplotlib.pyplot as plt

    if mpl.get_backend().lower() == "agg":
        raise SpecError("There is no screen to open a window on: give --out a file (.png, .svg or .pdf).", path="--out")
    plot_data(found, design=design, show=parts)
    plt.show()


def _undated(target: Path) -> dict[str, Any] | None:
    """Return what keeps the date out of a file, so that the same data give the same picture."""
    return {".svg": {"Date": None}, ".pdf": {"CreationDate": None}}.get(target.suffix.lower())
