"""Writes the encoder of trained weights as an ONNX file, which agents without torch run."""

import tempfile
import warnings
from pathlib import Path

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn

from semcast.common.errors import CheckpointError, ConfigError
from semcast.common.nets.checkpoint import load_transceiver
from semcast.common.nets.manifest import weights_path
from semcast.common.nets.onnx_encoder import FORMAT, INPUTS, OUTPUT, VALUES_INPUT, VARIABLE_FORMAT
from semcast.common.nets.packing import share_plane
from semcast.common.nets.rounding import rounded_snr_db
from semcast.common.nets.vit import VitEncoder
from semcast.common.phy.slots import LATENT_CHANNELS
from semcast.common.whole_file import write_whole
from semcast.training.data import read_images
from semcast.training.onnx_int8 import quantise

OPSET = 17
_HALVE_FROM_VALUES = 256


class _ImageToLatent(nn.Module):
    """The encoder from the bytes of an image on."""

    def __init__(self, encoder: nn.Module) -> None:
        super().__init__()
        self.encoder = encoder

    def forward(self, image: Tensor, snr_db: Tensor, values: Tensor | None = None) -> Tensor:
        x = image.permute(0, 3, 1, 2).to(torch.float32) * (1.0 / 255.0)
        told = (x, snr_db) if values is None else (x, snr_db, share_plane(values))
        latent: Tensor = self.encoder(*told)
        return latent


def export_encoder(name_or_path: str | Path, out: Path, int8_images: Path | None = None) -> Path:
    """Export the encoder of shipped weights or of a weights file.

    Weights stay in half precision in the file and are widened when it is loaded. The graph takes ``image``
    ``(1, H, W, 3)`` uint8 with sides that are multiples of 16, and the ``snr_db`` ``(1,)`` at which values
    arrive; it gives ``latent (1, 94, H/16, W/16)``. That of a variable rate also takes the ``values``
    ``(1, 1, H/16, W/16)`` each block sends, and gives more of them.

    Args:
        name_or_path: Shipped name or weights file.
        out: File to write.
        int8_images: Folder of photos; with one, convolutions become eight-bit (see ``onnx_int8``).

    Raises:
        CheckpointError: There are no such weights, or the file can't be written.
        ConfigError: The encoder is a transformer.
        SourceError: The folder holds no images.
    """
    images = [] if int8_images is None else read_images(int8_images)
    model, manifest = load_transceiver(weights_path(name_or_path))
    if isinstance(model.encoder, VitEncoder):  # a graph would keep the windows of the image it was made with
        raise ConfigError(
            f"weights must be of an encoder of convolutions, got {manifest.architecture}, whose windows of "
            "attention follow the image size: its agent needs torch"
        )
    example: tuple[Tensor, ...] = (torch.zeros(1, 64, 96, 3, dtype=torch.uint8), torch.full((1,), 10.0))
    if model.is_variable:
        example = (*example, torch.full((1, 1, 4, 6), float(LATENT_CHANNELS)))
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory() as folder:
            graph = _exported(
                model.encoder, example, Path(folder) / "encoder.onnx", images, manifest.snr_range_db
            )
        halve_weights(graph)
        facts = {
            "semcast_format": VARIABLE_FORMAT if model.is_variable else FORMAT,
            "architecture": manifest.architecture,
            "digest": manifest.sha256[:16],
            "precision": "int8" if images else "float",
            "snr_min_db": str(manifest.snr_range_db[0]),
            "snr_max_db": str(manifest.snr_range_db[1]),
        }
        helper.set_model_props(graph, facts)
        write_whole(out, graph.SerializeToString())
    except OSError as err:
        raise CheckpointError(f"encoder {out} can't be written: {err}") from err
    return out


def _exported(
    encoder: nn.Module,
    example: tuple[Tensor, ...],
    path: Path,
    images: list[NDArray[np.uint8]],
    snr_range_db: tuple[float, float],
) -> onnx.ModelProto:
    """Return the graph of an encoder, with eight-bit convolutions where there are images.

    ``path`` is a file to work in.
    """
    sides = {1: "height", 2: "width"}
    names = [*INPUTS, VALUES_INPUT][: len(example)]
    axes = {"image": sides, OUTPUT: {2: "rows", 3: "columns"}, VALUES_INPUT: {2: "rows", 3: "columns"}}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the exporter, about its own future
        torch.onnx.export(
            _ImageToLatent(encoder).eval(),
            example,
            str(path),
            input_names=names,
            output_names=[OUTPUT],
            opset_version=OPSET,
            dynamic_axes={name: axes[name] for name in ("image", *names[2:], OUTPUT)},
            dynamo=False,
        )
    if images:
        low_db, high_db = snr_range_db
        convolutions = [node.name for node in onnx.load(str(path)).graph.node if node.op_type == "Conv"]
        quantise(path, convolutions, images, (float(rounded_snr_db(low_db)), high_db))
    return onnx.load(str(path))


def halve_weights(graph: onnx.ModelProto) -> None:
    """Keep large weights in half precision, as the weights file does, each widened by a Cast."""
    casts = []
    for tensor in list(graph.graph.initializer):
        values = numpy_helper.to_array(tensor)
        if tensor.data_type != TensorProto.FLOAT or values.size < _HALVE_FROM_VALUES:
            continue
        half = numpy_helper.from_array(values.astype(np.float16), tensor.name + "_half")
        graph.graph.initializer.remove(tensor)
        graph.graph.initializer.append(half)
        casts.append(helper.make_node("Cast", [half.name], [tensor.name], to=TensorProto.FLOAT))
    for cast in reversed(casts):
        graph.graph.node.insert(0, cast)
