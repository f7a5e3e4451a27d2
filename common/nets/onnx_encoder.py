"""The sending end of a learned codec on onnxruntime, for small computers without torch.

The exported graph maps an image to the latent; padding, modulation and pairing are a little numpy.
"""

import shlex
from pathlib import Path

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from semcast.common.codec import DecodedImage, EncodedImage, Modulation, ReceivedImage, check_modulation
from semcast.common.errors import CheckpointError, ConfigError
from semcast.common.nets.coder_input import coder_input
from semcast.common.nets.detail import allocation_for
from semcast.common.nets.latent import symbols_from_latent
from semcast.common.nets.manifest import SHIPPED_FOLDER
from semcast.common.nets.modulation_numpy import transmit
from semcast.common.nets.rounding import rounded_snr_db

SUFFIX = ".onnx"
#: Version of what the graph takes and gives, and of its metadata.
FORMAT = "2"
#: That of encoders of variable rate, which have a third input.
VARIABLE_FORMAT = "3"
INPUTS = ("image", "snr_db")
#: The values of each block, ``(1, 1, h, w)`` float32.
VALUES_INPUT = "values"
OUTPUT = "latent"


def encoder_path(name_or_path: str | Path) -> Path:
    """Return the file of an exported encoder, of a shipped name or of a path.

    That of weights (``.safetensors``) lies beside them, as their manifest does.

    Raises:
        CheckpointError: There is no such file.
    """
    path = Path(name_or_path)
    if path.suffix == ".safetensors":
        weights, path = path, path.with_suffix(SUFFIX)
        if not path.is_file():
            how = shlex.join(("semcast", "onnx", str(weights), "--out", str(path)))
            raise CheckpointError(
                f"no exported encoder {path} beside the weights, which sending without torch needs: install "
                f"torch (semcast[agent]) or, where it is installed, have it written: {how}"
            )
    elif path.suffix == SUFFIX and not path.is_file():
        raise CheckpointError(f"there is no exported encoder {path}")
    elif path.suffix != SUFFIX:
        path = SHIPPED_FOLDER / f"{name_or_path}{SUFFIX}"
        if not path.is_file():
            raise CheckpointError(
                f"no exported encoder {path.name}; write one with 'semcast onnx' where torch is installed"
            )
    return path


class OnnxEncoder:
    """The encoder of a codec; it can send, not receive.

    Args:
        name_or_path: Shipped name such as ``3dcsc-lite``, or an ``.onnx`` file of ``semcast onnx``.
        modulation: How symbols travel.
        num_threads: CPU threads; None leaves the library's choice.

    Attributes:
        name: Registry name of the architecture.
        digest: Of the weights the encoder was exported from: the server decodes with the same.
        modulation: How symbols travel.
        snr_range_db: SNRs in dB the encoder was trained for; others are clipped to them.
        precision: ``int8`` where convolutions are, else ``float``.

    Raises:
        CheckpointError: The file is missing, damaged or of another version.
        ConfigError: There is no such modulation.
        ValueError: The number of threads is not usable.
    """

    def __init__(
        self, name_or_path: str | Path, modulation: Modulation = "16qam", num_threads: int | None = None
    ) -> None:
        check_modulation(modulation)
        if num_threads is not None and num_threads < 1:
            raise ValueError(f"num_threads must be >= 1, got {num_threads}")
        path = encoder_path(name_or_path)
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = num_threads or 0
        options.inter_op_num_threads = 1
        options.log_severity_level = 3
        # A thread that spins between frames would take a small computer's core.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        # Planned ahead, memory is a third to half more, and that for each size of images; it is no faster.
        options.enable_mem_pattern = False
        try:
            self._session = onnxruntime.InferenceSession(
                str(path), options, providers=["CPUExecutionProvider"]
            )
            facts = self._session.get_modelmeta().custom_metadata_map
        except Exception as err:  # onnxruntime has no common class of errors
            raise CheckpointError(f"encoder {path} can't be read: {err}") from err
        if facts.get("semcast_format") not in (FORMAT, VARIABLE_FORMAT):
            raise CheckpointError(
                f"encoder {path} must have format {FORMAT} or {VARIABLE_FORMAT}, "
                f"got {facts.get('semcast_format')}"
            )
        try:
            self.name, self.digest = str(facts["architecture"]), str(facts["digest"])
            self.snr_range_db = float(facts["snr_min_db"]), float(facts["snr_max_db"])
        except KeyError as err:
            raise CheckpointError(f"encoder {path} does not say its {err}") from err
        self._is_variable = facts["semcast_format"] == VARIABLE_FORMAT
        self.precision = str(facts.get("precision", "float"))
        self.modulation: Modulation = modulation

    def encode(self, image: NDArray[np.uint8], snr_db: float) -> EncodedImage:
        """Encode one image; see ``NeuralCodec.encode``.

        Raises:
            ValueError: The image is not ``(H, W, 3)`` uint8, or has no pixel.
        """
        given = coder_input(image, snr_db, self.snr_range_db)
        is_qam = self.modulation == "16qam"
        arriving_db = rounded_snr_db(given.snr_db) if is_qam else given.snr_db
        inputs = {"image": given.image[None], "snr_db": np.array([arriving_db], dtype=np.float32)}
        allocation = allocation_for(given.image) if self._is_variable else None
        if allocation is not None:
            inputs[VALUES_INPUT] = allocation.values[None, None].astype(np.float32)
        latent = self._session.run([OUTPUT], inputs)[0][0]
        values = None if allocation is None else allocation.values
        return EncodedImage(
            shape_hw=given.shape_hw,
            symbols=symbols_from_latent(transmit(latent, self.modulation, values)),
            modulation=self.modulation,
            levels=given.levels,
            allocation=b"" if allocation is None else allocation.code,
        )

    def decode(self, received: ReceivedImage) -> DecodedImage:
        """Say that this end only sends.

        Raises:
            ConfigError: Always.
        """
        raise ConfigError("an exported encoder can't decode: a server needs torch (semcast[server])")
