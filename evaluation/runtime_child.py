"""One variant of a codec's runtime in its own process: instruction sets and threads are fixed at the start.

Reads one JSON line with the variant, answers with the precision when it is ready; every further line with a
count is answered with the wall times of that many calls.
"""

import json
import sys
import time

import numpy as np

from semcast.common.codecs import load_codec

_SNR_DB = 10.0


def main() -> None:
    """Serve until the input ends."""
    task = json.loads(sys.stdin.readline())
    height, width = task["shape_hw"]
    codec = load_codec(
        task["codec"],
        modulation="16qam",
        num_threads=task["threads"],
        device="cpu",
        runtime=task["runtime"],
        precision=task["precision"],
    )
    rng = np.random.default_rng(0)
    coarse = rng.integers(0, 256, (height // 16 + 1, width // 16 + 1, 3), dtype=np.uint8)
    image = np.ascontiguousarray(coarse.repeat(16, axis=0).repeat(16, axis=1)[:height, :width])
    encoded = codec.encode(image, _SNR_DB)
    snr, snr_db = 10.0 ** (_SNR_DB / 10.0), np.full(encoded.symbols.shape[0], _SNR_DB, dtype=np.float32)
    # The MMSE equaliser shrinks what it estimates.
    received = encoded.arrived(encoded.symbols * np.float32(snr / (1.0 + snr)), snr_db)

    def call() -> None:
        if task["work"] == "encode":
            codec.encode(image, _SNR_DB)
        else:
            codec.decode(received)

    for _ in range(3):
        call()
    print(json.dumps(getattr(codec, "precision", None)), flush=True)
    for line in sys.stdin:
        times_ms = []
        for _ in range(json.loads(line)):
            since_ns = time.perf_counter_ns()
            call()
            times_ms.append((time.perf_counter_ns() - since_ns) * 1e-6)
        print(json.dumps(times_ms), flush=True)


if __name__ == "__main__":
    main()
