"""Markers and ticks of a session on the Lab Streaming Layer, to align them with other recordings.

Two streams: `AirHockeyMarkers`, a text per event (consent, begin oahg_ut, scored, goal, goal against, end oahg_ut,
rated oahg_ut), and `AirHockeyTicks`, the columns of `guidance.sessions.tick_log.COLUMNS` at 50 Hz.
"""

from collections.abc import Mapping

from guidance.sessions.tick_log import COLUMNS

MARKERS, TICKS = "AirHockeyMarkers", "AirHockeyTicks"


class LabStreams:
    """The events and ticks of a session, sent to two stream outlets."""

    def __init__(self) -> None:
        try:
            import pylsl
        except ModuleNotFoundError as error:
            raise ValueError("lsl = true needs the package pylsl: pip install -e '.[lsl]'") from error
        markers = pylsl.StreamInfo(MARKERS, "Markers", 1, pylsl.IRREGULAR_RATE, pylsl.cf_string, "airhockey-markers")
        ticks = pylsl.StreamInfo(TICKS, "Behavior", len(COLUMNS), 50.0, pylsl.cf_double64, "airhockey-ticks")
        channels = ticks.desc().append_child("channels")
        for name, description in COLUMNS.items():
            channel = channels.append_child("channel")
            channel.append_child_value("label", name)
            channel.append_child_value("unit", description["Units"])
        self._markers, self._ticks = pylsl.StreamOutlet(markers), pylsl.StreamOutlet(ticks)

    def mark(self, event: str) -> None:
        """Send a marker."""
        self._markers.push_sample([event])

    def tick(self, row: Mapping[str, float]) -> None:
        """Send a tick; missing values are NaN."""
        self._ticks.push_sample([float(row[name]) for name in COLUMNS])
