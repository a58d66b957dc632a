"""Jitter of the servo loop, alone and beside a busy process."""

import subprocess
import sys
import time
from dataclasses import asdict

from guidance.haptics.safety import SafetyLimits
from guidance.haptics.servo import SERVO_HZ
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
    servo = ServoProcess(("tests.guidance.haptics.fake_device", "Still", {}), SafetyLimits())
    try:
        began = time.perf_counter()
        while time.perf_counter() - began < seconds:
            servo.push((1.0, 0.5))
            time.sleep(TICK)
        timing, elapsed = asdict(servo.timing()), time.perf_counter() - began
    finally:
        servo.close()
        if spinning is not None:
            spinning.kill()
            spinning.wait()
    micro = {f"period_{name}_us": round(1e6 * timing[name]) for name in ("p50", "p99", "longest")}
    lost = max(1 - timing["steps"] / (elapsed * SERVO_HZ), 0.0)
    return {
        **micro,
        "steps": timing["steps"],
        "late_share": round(timing["late"] / max(timing["steps"], 1), 5),
        "lost_share": round(lost, 5),
    }
