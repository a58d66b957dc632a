"""Markers and ticks of a session on the Lab Streaming Layer, so that other recordings can be aligned with them.

Two streams: `AirHockeyMarkers`, a text when something happens (consent, begin oahg_ut, scored, goal, goal against, end
oahg_ut, rated oahg_ut), and `AirHockeyTicks`, the columns of `guidance.study.tick_log.COLUMNS` at 50 Hz.
"""

from collections.abc import Mapping

from guidance.study.tick_log import COLUMNS

MARKERS, TICKS = "AirHockeyMarkers", "AirHockeyTicks"


class LabStreams:
    """The two outlets. Whoever listens sees what is said from then on; nobody needs to."""

    def __init__(self) -> None:
        import pylsl

        markers = pylsl.StreamInfo(MARKERS, "Markers", 1, pylsl.IRREGULAR_RATE, pylsl.cf_string, "airhockey-markers")
        ticks = pylsl.StreamInfo(TICKS, "Behavior", len(COLUMNS), 50.0, pylsl.cf_double64, "airhockey-ticks")
        channels = ticks.desc().append_child("channels")
        for name, about in COLUMNS.items():
            channel = channels.append_child("channel")
            channel.append_child_value("label", name)
            channel.append_child_value("unit", about["Units"])
        self._markers, self._ticks = pylsl.StreamOutlet(markers), pylsl.StreamOutlet(ticks)

    def mark(self, what: str) -> None:
        """Say that something happens now."""
        self._markers.push_sample([what])

    def tick(self, row: Mapping[str, float]) -> None:
        """Say what a tick was; what is missing is not a number."""
        self._ticks.push_sample([float(row[name]) for name in COLUMNS])


def open_streams() -> LabStreams:
    """The streams.

    Raises:
        ValueError: the package is not installed; says how to.
    """
    try:
        return LabStreams()
    except ModuleNotFoundError as error:
        raise ValueError("lsl = true needs the package pylsl: pip install -e '.[lsl]'") from error
