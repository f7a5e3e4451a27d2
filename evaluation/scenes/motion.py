"""Where cameras look and how hands and cars shake them."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
#: How a camera is moved: with care, as people do, in a hurry.
Pace = Literal["gentle", "normal", "fast"]
#: Factor on speeds and shake for each pace.
PACE_FACTOR: dict[Pace, float] = {"gentle": 0.5, "normal": 1.0, "fast": 2.0}


def look(position_m: Array, yaw_rad: float, pitch_rad: float, roll_rad: float = 0.0) -> Array:
    """Return ``T_world_cam`` of a camera in a world with z up.

    Args:
        position_m: ``(3,)`` where it stands.
        yaw_rad: Heading of its view, from the world's x towards y.
        pitch_rad: Upwards positive.
        roll_rad: About its view.
    """
    forward = np.array(
        [np.cos(pitch_rad) * np.cos(yaw_rad), np.cos(pitch_rad) * np.sin(yaw_rad), np.sin(pitch_rad)]
    )
    right = np.array([np.sin(yaw_rad), -np.cos(yaw_rad), 0.0])
    down = np.cross(forward, right)
    cos, sin = np.cos(roll_rad), np.sin(roll_rad)
    T_world_cam = np.eye(4)
    T_world_cam[:3, :3] = np.column_stack([cos * right + sin * down, cos * down - sin * right, forward])
    T_world_cam[:3, 3] = position_m
    return T_world_cam


@dataclass(frozen=True)
class Wobble:
    """A smooth random signal: a sum of sines.

    Attributes:
        frequencies_hz: ``(N,)`` of the sines.
        phases_rad: ``(N,)`` of the sines.
        amplitudes: ``(N,)`` of the sines.
    """

    frequencies_hz: Array
    phases_rad: Array
    amplitudes: Array

    @classmethod
    def drawn(cls, rng: np.random.Generator, sd: float, low_hz: float, high_hz: float) -> "Wobble":
        """Return a signal of standard deviation ``sd`` with most of its power at low frequencies."""
        frequencies = np.exp(rng.uniform(np.log(low_hz), np.log(high_hz), 6))
        amplitudes = 1.0 / np.sqrt(frequencies)
        amplitudes *= sd * np.sqrt(2 / np.sum(amplitudes**2))
        return cls(frequencies, rng.uniform(0, 2 * np.pi, 6), amplitudes)

    def at(self, t_s: float) -> float:
        """Return the value at a time."""
        phases = 2 * np.pi * self.frequencies_hz * t_s + self.phases_rad
        return float(self.amplitudes @ np.sin(phases))
