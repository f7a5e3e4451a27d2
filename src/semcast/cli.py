"""The ``semcast`` command: finds the verb, runs it, turns errors into one line and an exit code.

Verbs live in ``semcast.commands``, one module each with ``add_arguments(parser)`` and ``run(arguments)``.
Only the chosen verb is imported, so ``semcast --help`` answers without torch, gtsam or rerun.
"""

import argparse
import contextlib
import importlib
import io
import logging
import os
import re
import shutil
import sys
import textwrap
import traceback
from collections.abc import Container, Iterator, Sequence
from typing import TYPE_CHECKING, Any, NoReturn, TextIO, cast

from semcast import SemcastError, __version__
from semcast.common.argument_order import arguments_last
from semcast.common.config import MissingSettingError, near_match
from semcast.common.heap import keep_freed_memory
from semcast.common.interrupts import ctrl_c_held

if TYPE_CHECKING:
    from _typeshed import SupportsWrite

#: Verbs that go through frames: their matrices, and those of windows of keyframes, are small.
_WITH_FRAMES = frozenset({"agent", "server", "replay", "eval", "lens", "shutter"})
#: verb -> (module in semcast.commands, one line of help)
VERBS: dict[str, tuple[str, str]] = {
    "demo": ("demo", "run agent, channel and server together on a recorded sequence and watch"),
    "agent": ("agent", "encode a camera or a recorded sequence and publish channel symbols"),
    "channel": ("channel", "run the simulated radio link, or change it while it runs"),
    "server": ("server", "decode, track, map and show what an agent sends"),
    "record": ("record", "keep everything a running system sends in one file"),
    "replay": ("replay", "reconstruct again from a recording, as received or through another channel"),
    "play": ("play", "send a recorded stream again, to a live server or channel"),
    "recover": ("recover", "make a recording that was cut off whole again"),
    "export": ("export", "write a run in the format of COLMAP, nerfstudio, evo, Rerun or as points"),
    "plot": ("plot", "draw a run: its path against the truth, and what happened over time"),
    "info": (
        "info",
        "say what a recording, run, sequence, video, bag or weights file is, in a screenful",
    ),
    "unpack": ("unpack", "turn a ROS bag into a sequence: images, times, camera, true path"),
    "calibrate": ("calibrate", "find a camera's intrinsics from pictures of a chessboard or live"),
    "lens": ("lens", "find a camera's intrinsics from a video or live, without a chessboard"),
    "shutter": ("shutter", "find how long a camera's rolling shutter takes, from a video or live"),
    "render": (
        "render",
        "draw a sequence with an exact path: room, office, street, block, lorry, orbit, survey, corridor",
    ),
    "eval": ("evaluate", "measure trajectories, frame pairs, codecs and confidence offline"),
    "train": ("train", "train a transceiver from a settings file"),
    "onnx": ("onnx", "write a codec's encoder for agents without torch"),
    "doctor": ("doctor", "check this machine and a running system, and say what to mend"),
}

#: verb -> extra of the package with all it needs; of verbs that are not named it is ``server``.
_EXTRAS = {"agent": "agent", "play": "agent", "unpack": "ros", "train": "train", "onnx": "train"}

EXIT_OK, EXIT_ERROR, EXIT_USAGE, EXIT_INTERRUPTED = 0, 1, 2, 130


#: How argparse says that a word is none of some.
_WRONG_CHOICE = re.compile(r"argument (\S+): invalid choice: (.*) \(choose from (.*)\)")


def _unknown_options(words: list[str], known: Container[str]) -> list[str]:
    """Return options that are none, each with the words behind it.

    Argparse would take such a word for an argument of the verb, and say that this is wrong.
    """
    end = words.index("--") if "--" in words else len(words)
    unknown: list[str] = []
    is_unknown = False
    for word in words[:end]:
        if word.startswith("--"):
            is_unknown = word.split("=")[0] not in known
        if is_unknown:
            unknown.append(word)
    return unknown


class _Parser(argparse.ArgumentParser):
    """A parser that says what is wrong in a line, without the usage of dozens of options before it.

    Options are written in full: what is short for one of them today may be short for two tomorrow. Its help
    fails where standard output can't be written; argparse keeps that to itself.
    """

    def __init__(self, **settings: Any) -> None:
        super().__init__(allow_abbrev=False, **settings)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Refuse what is not known here, where a sub-verb's options are, and not in the verb above it.

        Who asks for help gets it, whatever else is wrong.
        """
        words = list(sys.argv[1:] if args is None else args)
        if self._subparsers is None:
            if not {"-h", "--help"}.isdisjoint(words):
                words = ["--help"]
            self._refuse(_unknown_options(words, self._option_string_actions))
        found, unknown = super().parse_known_args(words, namespace)
        self._refuse(unknown)
        if self._subparsers is None:
            found.known_options = frozenset(self._option_string_actions)
        return found, unknown

    def _refuse(self, unknown: list[str]) -> None:
        if unknown:
            option = next((word.split("=")[0] for word in unknown if word.startswith("--")), "")
            hint = near_match(option, [name for name in self._option_string_actions if name.startswith("--")])
            self.error(f"unrecognized arguments: {' '.join(unknown)}{hint}")

    def error(self, message: str) -> NoReturn:
        if found := _WRONG_CHOICE.fullmatch(message):
            name, got, names = (text.replace("'", "") for text in found.groups())
            message = f"{name} must be one of {names}, got {got}{near_match(got, names.split(', '))}"
        self.exit(EXIT_USAGE, f"{self.prog}: {message} ('{self.prog} --help' lists the options)\n")

    def _print_message(self, message: str, file: "SupportsWrite[str] | None" = None) -> None:
        if sys.stdout is not None and file is sys.stdout:
            file.write(message)
        else:
            super()._print_message(message, file)


def _overview() -> argparse.ArgumentParser:
    width = max(len(verb) for verb in VERBS) + 2
    columns = shutil.get_terminal_size().columns - 2  # argparse's own margin
    rows = "\n".join(
        textwrap.fill(text, columns, initial_indent=f"  {verb:<{width}}", subsequent_indent=" " * (width + 2))
        for verb, (_, text) in VERBS.items()
    )
    end = textwrap.fill(
        "'semcast VERB --help' lists the options of a verb. Exit codes: 0 good, 1 an error said in one line, "
        "2 wrong usage, 130 stopped by Ctrl-C.",
        columns,
    )
    parser = _Parser(
        prog="semcast",
        usage="semcast VERB [options]",
        description="Live 3D reconstruction over a link too poor for video.",
        epilog=f"verbs:\n{rows}\n\n{end}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"semcast {__version__}")
    parser.add_argument("verb", nargs="?", metavar="VERB", help=argparse.SUPPRESS)
    return parser


def verb_parser(verb: str) -> argparse.ArgumentParser:
    """Return the full parser of one verb, with the options every verb has."""
    module, text = VERBS[verb]
    parser = _Parser(prog=f"semcast {verb}", description=text[0].upper() + text[1:] + ".")
    parser.add_argument("--debug", action="store_true", help="show tracebacks and debug messages")
    with ctrl_c_held():  # what gtsam makes of it while it is imported is another error
        command = importlib.import_module(f"semcast.commands.{module}")
    command.add_arguments(parser)
    parser.set_defaults(command=command.run)
    return parser


def _configure_logging(debug: bool) -> logging.Handler:
    handler = logging.StreamHandler(sys.stderr)
    is_watched = sys.stderr is not None and sys.stderr.isatty()
    time = "%H:%M:%S" if is_watched else "%Y-%m-%dT%H:%M:%S"  # a log is read another day
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)-7s %(name)s: %(message)s", time))
    root = logging.getLogger("semcast")
    root.addHandler(handler)
    root.setLevel(logging.DEBUG if debug else logging.INFO)
    return handler


def _quieten_libraries() -> None:
    """Keep what OpenCV, FFmpeg, Rerun and Matplotlib say, which we know or say in words, off the terminal.

    They read this when a verb imports them. What the user has set holds.
    """
    logging.getLogger("matplotlib").setLevel(logging.ERROR)  # of a home that can't be written it makes do
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # AV_LOG_QUIET
    # Rerun warns of every file without a footer, and of full disks, which the server says by itself.
    os.environ.setdefault("RUST_LOG", "warn,re_log_encoding::rrd::file_sink=off,re_sdk::recording_stream=off")


def _leave_other_cores_alone() -> None:
    """Let no thread that waits for another one spin meanwhile; before numpy and torch are imported.

    OpenBLAS would share products of images wider than 950 pixels, and of adjustments, among all cores, and
    networks have threads of OpenMP: on a machine that has other work, whoever spins keeps the one that is
    waited for from its core, and what takes a millisecond then takes many, on all cores. So numpy computes in
    the thread that asks, and threads of networks sleep while they wait. What the user has set holds.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


def _show_all_names() -> None:
    """Let stdout show names of files that are no text, or not in its encoding, by escapes: it would fail."""
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors == "strict":
        sys.stdout.reconfigure(errors="backslashreplace")


def _plain(err: SemcastError) -> str:
    """Return an error in words: what the system said of a file without its number and the file again."""
    cause = err.__cause__
    while isinstance(cause, SemcastError):
        cause = cause.__cause__
    if isinstance(cause, OSError) and cause.strerror:
        return str(err).replace(str(cause), cause.strerror)
    return str(err)


def _by_options(message: str, known: Container[str]) -> str:
    """Call the setting that an error begins with, and one that it needs, by their options.

    Of a setting that was not given, and of all after they are read, errors say the name it has in a file.

    Args:
        message: Such as ``"warmup must leave frames to time, got 5 of 3"``.
        known: Options of the verb; none where a file was given, in which the setting may stand.
    """

    def option(name: str) -> str:
        shown = "--" + name.replace("_", "-")
        return shown if shown in known else name

    message = re.sub(r"^\w+(?= (must|can't) )", lambda found: option(found[0]), message)
    return re.sub(r"^(--\S+(?: '\S+')? needs )(\w+)", lambda found: found[1] + option(found[2]), message)


def _stdout_fails() -> bool:
    try:
        print(flush=True)
    except OSError:
        return True
    return False


def _drop(stream: TextIO) -> None:
    """Let what a stream still holds go nowhere: the interpreter would try again at the end, and trace."""
    with contextlib.suppress(OSError):  # one that is no file
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


class _Talk:
    """Standard error, where lines that can't be written are left out: they must not cost a result."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """Write the text, if that is possible."""
        with contextlib.suppress(OSError):
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        """Write what is held, if that is possible."""
        with contextlib.suppress(OSError):
            self._stream.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextlib.contextmanager
def _talk_may_be_lost() -> Iterator[None]:
    """Go on, and end with the same exit code, where standard error can't be written."""
    stream = sys.stderr
    if stream is None:  # it is closed, and print would take standard output for it
        with open(os.devnull, "w") as nowhere, contextlib.redirect_stderr(nowhere):
            yield
        return
    sys.stderr = cast("TextIO", _Talk(stream))
    try:
        yield
    finally:
        sys.stderr = stream
        try:
            stream.flush()
        except OSError:
            _drop(stream)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    words = list(sys.argv[1:] if argv is None else argv)
    _show_all_names()
    with _talk_may_be_lost():
        return _main(words)


def _main(words: list[str]) -> int:
    try:
        try:
            return _run(words)
        finally:
            if sys.stdout is not None:
                sys.stdout.flush()
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    except OSError as err:
        if not _stdout_fails() or "--debug" in words:
            raise
        _drop(sys.stdout)
        if not isinstance(err, BrokenPipeError):  # who reads no further knows
            print(f"semcast: standard output can't be written: {err.strerror}", file=sys.stderr)
        return EXIT_ERROR


def _run(words: list[str]) -> int:
    overview = _overview()
    if words[:1] == ["help"]:
        words = [*words[1:2], "--help"]
    if not words or words[0].startswith("-"):
        overview.parse_args(words)
        overview.print_help()
        return EXIT_OK if not words else EXIT_USAGE
    verb = words[0]
    if verb not in VERBS:
        overview.print_usage(sys.stderr)
        print(f"semcast: unknown verb {verb!r}{near_match(verb, list(VERBS))}", file=sys.stderr)
        return EXIT_USAGE
    debug = "--debug" in words
    handler = _configure_logging(debug)
    if not debug:
        _quieten_libraries()
    if verb in _WITH_FRAMES:
        _leave_other_cores_alone()
    if verb in _WITH_FRAMES - {"agent"}:  # which may have little memory, and knows how it encodes
        keep_freed_memory()
    known: Container[str] = ()
    try:
        parser = verb_parser(verb)
        arguments = parser.parse_args(arguments_last(parser, words[1:]))
        if getattr(arguments, "config", None) is None:
            known = arguments.known_options
        return int(arguments.command(arguments))
    except MissingSettingError as err:
        print(f"semcast {verb}: {err}", file=sys.stderr)
        return EXIT_USAGE
    except SemcastError as err:
        if debug:
            traceback.print_exc()
        print(f"semcast {verb}: {_by_options(_plain(err), known)}", file=sys.stderr)
        return EXIT_ERROR
    except PermissionError as err:  # Path.is_file raises it in a folder that may not be looked into
        if debug:
            traceback.print_exc()
        where = "" if err.filename is None else f": {err.filename}"
        print(f"semcast {verb}: {err.strerror or err}{where}", file=sys.stderr)
        return EXIT_ERROR
    except ModuleNotFoundError as err:
        if debug or (err.name or "").startswith("semcast"):
            raise
        # Nothing is released yet, so a package index has no semcast, or another.
        print(
            f"semcast {verb}: the package {err.name!r} is not installed; install semcast with the extra this "
            f"verb needs, in its checkout: pip install '.[{_EXTRAS.get(verb, 'server')}]'",
            file=sys.stderr,
        )
        return EXIT_ERROR
    finally:
        logging.getLogger("semcast").removeHandler(handler)
