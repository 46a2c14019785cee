"""Installed methods: those of obsynth, and those of other packages with the entry point ``obsynth.methods``.

Nothing of a method is imported here: `obsynth.methods.registry` does that when it is used.
"""

from __future__ import annotations

from collections import UserDict
from collections.abc import Iterator

from obsynth.errors import SpecError

#: The group of entry points, and what it holds: ``id = "module:Class"``, a class derived from `Method`.
GROUP = "obsynth.methods"

#: Method id -> its class, ``module:name``; a method is its own folder and a line here.
OWN = {
    "fault-estimation-filter": "obsynth.methods.fault_estimation_filter.method:FaultEstimationFilter",
    "pd-observer": "obsynth.methods.pd_observer.method:PdObserver",
    "ui-pi-observer": "obsynth.methods.ui_pi_observer.method:UiPiObserver",
    "functional-filter": "obsynth.methods.functional_filter.method:FunctionalFilter",
    "optimal-filter": "obsynth.methods.optimal_filter.method:OptimalFilterMethod",
    "detection-filter": "obsynth.methods.detection_filter.method:DetectionFilterMethod",
    "descriptor-kalman": "obsynth.methods.descriptor_kalman.method:DescriptorKalman",
    "adaptive-observer": "obsynth.methods.adaptive_observer.method:AdaptiveObserver",
    "dae-adaptive-observer": "obsynth.methods.dae_adaptive_observer.method:DaeAdaptiveObserver",
    "extended-kalman": "obsynth.methods.extended_kalman.method:ExtendedKalman",
    "region-observer": "obsynth.methods.region_observer.method:RegionObserverMethod",
    "guaranteed-test": "obsynth.methods.guaranteed_test.method:GuaranteedTestMethod",
}


class MethodPlaces(UserDict[str, str]):
    """Method id -> ``module:name``; other packages are asked only for ids that obsynth itself does not know."""

    def __init__(self) -> None:
        super().__init__(OWN)
        self._asked = False

    def _add_registered(self) -> None:
        """Take in what other packages register; obsynth's own ids stay what they are."""
        if self._asked:
            return
        from importlib.metadata import entry_points

        self._asked = True
        for entry in entry_points(group=GROUP):
            self.data.setdefault(entry.name, entry.value)

    def __contains__(self, key: object) -> bool:
        if key not in self.data:
            self._add_registered()
        return key in self.data

    def __missing__(self, key: str) -> str:
        self._add_registered()
        return self.data[key]

    def __iter__(self) -> Iterator[str]:
        self._add_registered()
        return iter(self.data)

    def __len__(self) -> int:
        self._add_registered()
        return len(self.data)


REGISTRY = MethodPlaces()


def not_loadable(method: str, reason: object) -> SpecError:
    """Return the error that a method's class cannot be had."""
    return SpecError(
        f"The method {method!r} is registered as {REGISTRY[method]!r}, which cannot be loaded ({reason}): repair or "
        "uninstall the package that registers it.",
        path="method",
    )
