"""Markers and ticks of a session arrive at a listener on the Lab Streaming Layer, complete and in order."""

import numpy as np
import pytest

from guidance.sessions.lsl import MARKERS, TICKS, LabStreams
from guidance.sessions.tick_log import COLUMNS

pylsl = pytest.importorskip("pylsl", exc_type=(ImportError, RuntimeError))


def listener(name: str) -> "pylsl.StreamInlet":
    found = pylsl.resolve_byprop("name", name, timeout=10)
    if not found:
        pytest.skip("this machine lets nobody be found on its network")
    inlet = pylsl.StreamInlet(found[0])
    inlet.open_stream(timeout=10)
    return inlet


def test_markers_and_ticks_arrive():
    streams = LabStreams()
    markers, ticks = listener(MARKERS), listener(TICKS)
    assert streams._markers.wait_for_consumers(10) and streams._ticks.wait_for_consumers(10)
    rows = [{name: float(i + tick) for i, name in enumerate(COLUMNS)} for tick in range(3)]
    rows[1]["w_sim"] = float("nan")
    streams.mark("begin oahg_ut")
    for row in rows:
        streams.tick(row)
    streams.mark("goal")
    assert [markers.pull_sample(timeout=60)[0][0] for _ in range(2)] == ["begin oahg_ut", "goal"]
    received = [ticks.pull_sample(timeout=60) for _ in range(3)]
    assert np.array_equal([sample for sample, _ in received], [list(row.values()) for row in rows], equal_nan=True)
    assert received[0][1] <= received[1][1] <= received[2][1]
    description = ticks.info(timeout=60).desc().child("channels").child("channel")
    assert description.child_value("label") == "time_s" and description.child_value("unit") == "s"


def test_without_the_package_the_command_says_what_to_install(monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "pylsl", None)
    with pytest.raises(ValueError, match=r"pip install -e '.\[lsl\]'"):
        LabStreams()
