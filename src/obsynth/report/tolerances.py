"""What a design promises over the tolerances of its plant, for people."""

from __future__ import annotations

from rich.console import Console
from rich.text import Text

from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.report.layout import facts_table, print_section
from obsynth.results.design import ObserverDesign


def tolerances_report(design: ObserverDesign, *, console: Console) -> None:
    """Print what holds for every plant within its tolerances, or that the design assumes an exact model."""
    from obsynth.tolerances.robustness import EXACT_MODEL, robustness

    if not isinstance(design.plant, DescriptorSystem) or not isinstance(design.observer, LinearObserver):
        return
    uncertain = design.plant.uncertainty
    if uncertain is None or not uncertain.box.names:
        console.print(Text(f"Model: {EXACT_MODEL} (no constant has a tolerance)."))
        return
    print_section(console, "Within the tolerances of the plant", facts_table(robustness(design).facts()))
