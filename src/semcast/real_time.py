"""How large images may be, and how many a second, for all processes to keep up on this machine."""

import math
import multiprocessing
import threading
import time
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.channel.settings import ChannelSettings
from semcast.common.codec import Codec, Modulation
from semcast.common.codecs import load_codec
from semcast.common.cores import usable_cores
from semcast.common.errors import SemcastError
from semcast.common.image import resized, scaled_wh
from semcast.common.interrupts import deaf_children
from semcast.common.parent import end_with_parent
from semcast.common.rate import NATIVE_RATE, RateChoice, to_coded

#: Larger images gain little.
MAX_PIXELS = 250_000
#: Images get smaller first, down to this share of the pixels, then fewer a second.
_MIN_SHARE = 0.6
#: Share of the cores' time that may be planned: beyond it frames have to wait for each other.
_USABLE = 0.5
#: Everything but coding (tracker, bundle adjustment, viewer, transport), in units of following 500 points.
_OTHER_WORK = 4.5
#: The share of it that does not depend on the image size.
_FIXED_SHARE = 0.6
#: Cores that are of use to one stream, at most.
_MAX_CORES = 4
#: A recording is played slower only if it is worth it: the measurement is no better.
_FULL_PACE = 0.9
_MEASURE_S = 1.0
_POLL_S = 0.1
_MAX_CALLS = 7


@dataclass(frozen=True)
class Speed:
    """What a core of this machine, as it is loaded now, needs for one image while the others work too.

    Attributes:
        coding_ms: Encoding and decoding.
        following_ms: Following 500 points to the next image and back.
    """

    coding_ms: float
    following_ms: float


@dataclass(frozen=True)
class Plan:
    """What a demo sends.

    Attributes:
        resize: Factor on the image size.
        rate_hz: Images a second.
    """

    resize: float
    rate_hz: float


def make_plan(
    speed: Speed, shape_hw: tuple[int, int], rate_hz: float, cores: int, resize: float | None = None
) -> Plan:
    """Choose the size of images, and how many a second, that a machine can serve.

    Args:
        speed: For an image of ``shape_hw`` brought down to ``MAX_PIXELS`` if it is larger.
        shape_hw: Height and width of the recorded images.
        rate_hz: Images a second of the recording; never exceeded.
        cores: Of the machine.
        resize: Factor on the image size that is asked for, or None to choose it.
    """
    height, width = shape_hw
    largest = _resize_to(MAX_PIXELS, shape_hw)
    fixed_ms = _OTHER_WORK * speed.following_ms * _FIXED_SHARE
    growing_ms = _OTHER_WORK * speed.following_ms * (1.0 - _FIXED_SHARE) + speed.coding_ms
    usable_ms = 1e3 * min(cores, _MAX_CORES) * _USABLE
    if resize is None:
        share = min(1.0, max(_MIN_SHARE, (usable_ms / rate_hz - fixed_ms) / growing_ms))
        resize = min(largest, _resize_to(share * largest**2 * height * width, shape_hw))
    served_hz = usable_ms / (fixed_ms + (resize / largest) ** 2 * growing_ms)
    return Plan(resize, served_hz if served_hz < _FULL_PACE * rate_hz else rate_hz)


def _resize_to(pixels: float, shape_hw: tuple[int, int]) -> float:
    """Return the factor, at most 1, that brings an image down to so many pixels."""
    height, width = shape_hw
    return min(1.0, round(math.sqrt(pixels / (height * width)), 2))


def measure_speed(
    codec: str,
    modulation: Modulation,
    image: NDArray[np.uint8],
    rate: RateChoice = NATIVE_RATE,
    num_cores: int = 1,
    snr_db: float = ChannelSettings.snr_db,
) -> Speed:
    """Time the work on one image on each of some cores at the same time, for a second or two.

    Cores that work at the same time share caches, memory and what else runs on the machine: one core alone
    would promise too much.

    Args:
        codec: Codec by name.
        modulation: How symbols travel.
        image: ``(H, W, 3)`` uint8 RGB, at the size at which it is sent.
        rate: Channel uses per pixel value; ``auto`` is taken for the native one.
        num_cores: Cores to measure.
        snr_db: Of the link: LDPC of a fixed rate is decoded in several times as long where the link is poor.

    Raises:
        ConfigError: The codec is unknown.
        CheckpointError: Its weights are missing or damaged.
    """
    coded = to_coded(image, NATIVE_RATE if rate == "auto" else rate)
    coders = [load_codec(codec, modulation=modulation, num_threads=1) for _ in range(num_cores)]
    cv2.setNumThreads(1)
    with ThreadPoolExecutor(num_cores) as pool:
        coding_ms = list(pool.map(lambda coder: _coding_ms(coder, coded, snr_db), coders))
        following_ms = list(pool.map(_following_ms, [image] * num_cores))
    return Speed(_mean_ms(coding_ms), _mean_ms(following_ms))


def _mean_ms(times_ms: list[float]) -> float:
    """Return the time in which all cores together do as many images as there are cores."""
    return len(times_ms) / sum(1.0 / ms for ms in times_ms)


def _coding_ms(coder: Codec, coded: NDArray[np.uint8], snr_db: float) -> float:
    rng = np.random.default_rng(0)
    noise_var = 10.0 ** (-snr_db / 10.0)
    shrink = 1.0 / (1.0 + noise_var)
    times_s: list[float] = []
    until_s = math.inf
    while len(times_s) <= _MAX_CALLS and time.perf_counter() < until_s:
        since_s = time.perf_counter()
        encoded = coder.encode(coded, snr_db)
        encoded_s = time.perf_counter() - since_s
        noise = rng.standard_normal((2, *encoded.symbols.shape)) * math.sqrt(noise_var / 2.0)
        symbols = (shrink * (encoded.symbols + noise[0] + 1j * noise[1])).astype(np.complex64)
        slot_snr_db = np.full(symbols.shape[0], snr_db, np.float32)
        since_s = time.perf_counter()
        coder.decode(encoded.arrived(symbols, slot_snr_db))
        times_s.append(encoded_s + time.perf_counter() - since_s)
        if until_s == math.inf:
            until_s = time.perf_counter() + _MEASURE_S  # the first call, which warms up, counts for nothing
    return 1e3 * float(np.median(times_s[1:] or times_s))


def _following_ms(image: NDArray[np.uint8]) -> float:
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    moved = np.roll(grey, (2, 3), axis=(0, 1))
    times_s = []
    for _ in range(_MAX_CALLS):
        since_s = time.perf_counter()
        points = cv2.goodFeaturesToTrack(grey, 500, 0.01, 8)
        if points is not None:
            there = cv2.calcOpticalFlowPyrLK(grey, moved, points, None)[0]  # type: ignore[call-overload]
            cv2.calcOpticalFlowPyrLK(moved, grey, there, None)  # type: ignore[call-overload]
        times_s.append(time.perf_counter() - since_s)
    return 1e3 * float(np.median(times_s))


def plan_for(
    codec: str,
    modulation: Modulation,
    image: NDArray[np.uint8],
    rate_hz: float,
    rate: RateChoice = NATIVE_RATE,
    resize: float | None = None,
    stop: threading.Event | None = None,
    snr_db: float = ChannelSettings.snr_db,
) -> Plan | None:
    """Measure this machine and choose what it can serve; None when ``stop`` was set before.

    It is measured in a process of its own, so that the codec's libraries don't stay in this one.

    Args:
        codec: Codec by name.
        modulation: How symbols travel.
        image: ``(H, W, 3)`` uint8 RGB, one of those to be sent.
        rate_hz: Images a second of the recording.
        rate: Channel uses per pixel value.
        resize: Factor on the image size that is asked for, or None to choose it.
        stop: Ends it early.
        snr_db: Of the link.

    Raises:
        ConfigError: The codec is unknown.
        CheckpointError: Its weights are missing or damaged.
        SemcastError: The process of the measurement died.
    """
    height, width = image.shape[:2]
    cores = usable_cores()
    largest = _resize_to(MAX_PIXELS, (height, width))
    smaller = resized(image, scaled_wh(width, height, largest))
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), end_with_parent) as pool:
        with deaf_children():  # Ctrl-C is this process's business
            measured = pool.submit(
                measure_speed, codec, modulation, smaller, rate, min(cores, _MAX_CORES), snr_db
            )
            children = multiprocessing.active_children()
        while not wait([measured], _POLL_S).done:
            if stop is not None and stop.is_set():
                for child in children:
                    child.kill()
                return None
        try:
            speed = measured.result()
        except BrokenProcessPool as err:
            raise SemcastError(
                "the process that measures this machine ended early, perhaps for want of memory: with "
                "--resize and --rate-hz nothing is measured"
            ) from err
    return make_plan(speed, (height, width), rate_hz, cores, resize)
