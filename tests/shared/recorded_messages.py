"""Messages to record, and what a recording of them holds."""

import io

import numpy as np

from semcast.common.recording_reader import RecordedMessage, RecordingScan
from semcast.common.recording_writer import recording_metadata

HEADER = recording_metadata('codec = "3dcsc"\n', "9.9")
TOPICS = (("semcast/a/rx/symbols", "symbols"), ("semcast/a/pose", "pose"), ("semcast/a/link", "link"))


def made_messages(count=120, seed=0):
    """Messages of unlike sizes, every payload findable in the file by its first sixteen random bytes."""
    rng = np.random.default_rng(seed)
    sequence = dict.fromkeys(TOPICS, 0)
    messages = []
    for k in range(count):
        topic = TOPICS[k % 3]
        size = int(rng.integers(16, 900))
        messages.append((*topic, 1000 + 10 * k, sequence[topic], rng.bytes(size)))
        sequence[topic] += 1
    return messages


def scanned(data, strict=True):
    scan = RecordingScan(io.BytesIO(data), "bytes", strict=strict)
    records = list(scan.records())
    return [r for r in records if isinstance(r, RecordedMessage)], records, scan
