"""Jitter of the servo loop, alone and beside a busy process."""

import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from guidance.haptics.safety import SafetyLimits
from guidance.haptics.servo import PERIOD, SERVO_HZ
from guidance.haptics.servo_process import ServoProcess

TICK = 0.02  # s between two forces


def servo_jitter(seconds: float = 5.0, busy: bool = True) -> dict[str, float]:
    """Run the 1 kHz servo loop on a device without effect, with new forces at 50 Hz.

    Args:
        seconds: of measurement.
        busy: whether another process occupies one core.

    Returns:
        period_p50_us, period_p99_us, period_longest_us, steps, late_share and lost_share (missing steps).
    """
    spinning = subprocess.Popen([sys.executable, "-c", "while True: pass"]) if busy else None
    with TemporaryDirectory() as folder:
        times = Path(folder, "times")
        servo = ServoProcess(("tests.guidance.haptics.fake_device", "Timed", {"path": str(times)}), SafetyLimits())
        try:
            began = time.perf_counter()
            while time.perf_counter() - began < seconds:
                servo.push((1.0, 0.5))
                time.sleep(TICK)
            elapsed = time.perf_counter() - began
        finally:
            servo.close()
            if spinning is not None:
                spinning.kill()
                spinning.wait()
        period = np.diff(np.loadtxt(times))
    micro = {name: round(1e6 * np.quantile(period, q)) for name, q in (("p50", 0.5), ("p99", 0.99), ("longest", 1.0))}
    return {
        **{f"period_{name}_us": value for name, value in micro.items()},
        "steps": len(period),
        "late_share": round(float((period > 1.5 * PERIOD).mean()), 5),
        "lost_share": round(max(1 - len(period) / (elapsed * SERVO_HZ), 0.0), 5),
    }
