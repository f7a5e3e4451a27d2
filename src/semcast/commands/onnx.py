"""``semcast onnx``: the encoder of a learned codec as one file for agents without torch."""

import argparse
from pathlib import Path

from semcast.commands.paths import named_path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "weights",
        metavar="WEIGHTS",
        help="name of shipped weights such as 3dcsc-lite, or a .safetensors file",
    )
    parser.add_argument(
        "--out", type=named_path, metavar="FILE", help="file to write; by default the name with .onnx, here"
    )
    parser.add_argument(
        "--int8",
        type=named_path,
        metavar="FOLDER",
        help="eight-bit convolutions, about twice as fast; learns the ranges of values from photos in FOLDER",
    )


def run(arguments: argparse.Namespace) -> int:
    """Export and name the file on stdout."""
    from semcast.training.onnx_export import export_encoder

    out = arguments.out or Path(Path(arguments.weights).stem + ".onnx")
    print(export_encoder(arguments.weights, out, arguments.int8))
    return 0
