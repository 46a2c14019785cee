"""Notes of every design over the region of a polytopic plant."""

from __future__ import annotations

from obsynth.errors import counted
from obsynth.methods.engines.vertex_certificates import NEGLIGIBLE, VertexCertificate
from obsynth.plants.polytopic import PolytopicSystem


def certificate_note(plant: PolytopicSystem, for_how_long: str) -> str:
    """Return for what the certificate is, and that nothing is claimed ``for_how_long`` after a row outside."""
    corners = counted(plant.count, "vertex", "vertices")
    return (
        f"One certificate at {corners}, for the region {plant.scheduling.sentence()}. A row with a "
        "parameter outside or missing is out: the parameter is moved into its range, and nothing is claimed for "
        f"{for_how_long} from the last such row on."
    )


def unused_rate_notes(plant: PolytopicSystem, steps: float | None) -> list[str]:
    """Return the note that stated rates are not used by the certificate; empty where it uses one, by ``steps``."""
    rated = plant.scheduling.rated_names
    if not rated or steps is not None:
        return []
    return [
        f"The rate of {', '.join(rated)} is not used: the certificate is for every course. One with a rate is "
        "sought for one parameter that enters linearly and cannot cross its range within a sample."
    ]


def by_product_notes(certificate: VertexCertificate) -> list[str]:
    """Return the notes on numbers that are proved, but are no least ones: a gain of about zero, a first decay."""
    notes = []
    if certificate.is_negligible:
        notes.append(
            "The disturbances can be decoupled: the least gain is zero but for rounding. What is proved in its place, "
            f"{certificate.level:.3g}, is a share of what they do without any gain (the first of "
            f"{', '.join(f'{share:g}' for share in NEGLIGIBLE)} that could be proved), and says nothing else."
        )
    if not certificate.is_fastest:
        notes.append(
            "The decay is that of the certificate of the gain. With so many states and vertices a faster one at the "
            "same gain is not sought: state decay where you need one."
        )
    return notes
