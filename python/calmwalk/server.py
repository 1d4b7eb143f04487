"""Serves one potential to calmwalk: `python -m calmwalk.server`. See docs/python-protocol.md.

Messages come from standard input and are answered on what was standard output at the start. Standard output then goes
to standard error, so that what libraries print cannot mix with answers.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import time
import traceback
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Callable, Optional

from . import loading, protocol
from .errors import AdapterError, InputError

if TYPE_CHECKING:  # numpy reads the number of threads when it is imported: not before hello
    import numpy as np

    from .adapter import Adapter, Energies, ModelInfo
    from .arenas import Arenas, Call
    from .batch import Batch

_THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMEXPR_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
    "TF_NUM_INTRAOP_THREADS",
)
_OUT_OF_MEMORY = {"MemoryError", "OutOfMemoryError", "ResourceExhaustedError"}


class Server:
    """Answers messages. Holds one adapter after hello."""

    def __init__(self) -> None:
        self._name = "of calmwalk"
        self._adapter: Optional[Adapter] = None
        self._arenas: Optional[Arenas] = None

    def answer(self, line: bytes) -> dict[str, Any]:
        """The answer to one line. Never raises."""
        message: dict[str, Any] = {}
        try:
            message = protocol.parse(line)
            return self._call(message)
        except BaseException as error:
            if isinstance(error, (KeyboardInterrupt, GeneratorExit)):
                raise
            return self._failure(message, error)

    def _call(self, message: Mapping[str, Any]) -> dict[str, Any]:
        calls: dict[str, Callable[[Mapping[str, Any]], dict[str, Any]]] = {
            "hello": self._hello,
            "evaluate": self._evaluate,
            "pull_back": self._pull_back,
        }
        if message["call"] not in calls:
            raise InputError(f"the call is '{message['call']}', expected one of {', '.join(calls)}")
        return calls[message["call"]](message)

    def _hello(self, message: Mapping[str, Any]) -> dict[str, Any]:
        if message.get("protocol") != protocol.VERSION:
            raise InputError(f"calmwalk speaks protocol {message.get('protocol')!r}, this package {protocol.VERSION}")
        if self._adapter is not None:
            raise InputError("a second hello")
        self._name = str(message.get("adapter"))
        threads = int(message.get("threads") or 1)
        device = str(message.get("device") or "cpu")
        set_environment(threads, device)
        precision = message.get("precision") or "double"
        if precision not in ("double", "single"):
            raise InputError(f"the precision is {precision!r}, expected 'double' or 'single'")
        from .arenas import Arenas

        adapter = loading.find_adapter(self._name)(
            model=protocol.as_path(message.get("model"), "model"),
            options=dict(message.get("options") or {}),
            device=device,
            precision=precision,
            threads=threads,
            cache=protocol.as_path(message.get("cache"), "cache"),
        )
        answer = describe(self._name, adapter)
        self._adapter, self._arenas = adapter, Arenas()
        return answer

    def _evaluate(self, message: Mapping[str, Any]) -> dict[str, Any]:
        adapter, info = self._ready()
        features, forces = bool(message.get("features")), bool(message.get("forces", True))
        names = ["energies"] + (["forces", "virials"] if forces else []) + (["features"] if features else [])
        call = self._read(message, names)
        call.arena.evaluated = call.arena.kept = None
        if features and info.features.form == "none":
            raise InputError("features are asked for, but the model has none")
        without_forces = None if forces or not features else evaluates_without_forces(adapter)
        started = time.perf_counter()
        result: Any = without_forces(call.batch) if without_forces else adapter.evaluate(call.batch, features)
        seconds = time.perf_counter() - started
        self._write("evaluate", call, {name: getattr(result, name) for name in names})
        call.arena.evaluated, call.arena.kept = call.id, call.batch.kept
        return _done(call.id, seconds, result.compiled)

    def _pull_back(self, message: Mapping[str, Any]) -> dict[str, Any]:
        adapter, _ = self._ready()
        energy = ["energy_cotangents"] if message.get("energy") else []
        call = self._read(message, ["feature_cotangents", *energy, "gradients", "gradient_virials"])
        if message.get("kept") is not None and message["kept"] == call.arena.evaluated:
            call.batch.kept = call.arena.kept
        started = time.perf_counter()
        result = adapter.pull_back(call.batch, call.arrays["feature_cotangents"], call.arrays.get("energy_cotangents"))
        seconds = time.perf_counter() - started
        self._write("pull_back", call, {"gradients": result.gradients, "gradient_virials": result.virials})
        return _done(call.id, seconds, result.compiled)

    def _ready(self) -> tuple[Adapter, ModelInfo]:
        if self._adapter is None:
            raise InputError("a call before hello")
        return self._adapter, self._adapter.info

    def _read(self, message: Mapping[str, Any], sections: list[str]) -> Call:
        assert self._adapter is not None and self._arenas is not None
        return self._arenas.read(message, self._adapter.info.features.dimension, sections)

    def _write(self, call_name: str, call: Call, results: Mapping[str, np.ndarray]) -> None:
        for name, result in results.items():
            check_result(name, result, call.arrays[name])
        for name, result in results.items():
            call.arrays[name][...] = result

    def _failure(self, message: Mapping[str, Any], error: BaseException) -> dict[str, Any]:
        kind, text = classify(error)
        call = message.get("call", "a message")
        return {
            "status": "error",
            "id": message.get("id"),
            "kind": kind,
            "message": one_line(f"adapter {self._name}, {call}: {text}"),
            "traceback": "".join(traceback.format_exception(type(error), error, error.__traceback__)),
        }


def evaluates_without_forces(adapter: Adapter) -> Optional[Callable[[Batch], Energies]]:
    """The method of an adapter that can leave forces out."""
    method: Optional[Callable[[Batch], Energies]] = getattr(adapter, "evaluate_without_forces", None)
    return method


def describe(name: str, adapter: Adapter) -> dict[str, Any]:
    """The answer to hello."""
    import platform

    import numpy as np

    info = adapter.info
    n = len(info.elements)
    cutoffs = np.asarray(info.cutoffs, dtype=float)
    if cutoffs.shape != (n, n):
        raise ValueError(f"cutoffs has the shape {cutoffs.shape}, expected {(n, n)}")
    if info.features.form not in ("final", "raw", "none"):
        raise ValueError(f"features.form is '{info.features.form}', expected 'final', 'raw' or 'none'")
    return {
        "status": "ok",
        "protocol": protocol.VERSION,
        "adapter": name,
        "versions": {"python": platform.python_version(), "numpy": np.__version__, **info.versions},
        "device": info.device,
        "elements": list(info.elements),
        "cutoffs": cutoffs.tolist(),
        "features": {
            "form": info.features.form,
            "dimension": info.features.dimension,
            "blocks": [int(columns) for columns in info.features.blocks],
        },
        "precision": info.precision,
        "padding": info.padding,
        "evaluates_without_forces": evaluates_without_forces(adapter) is not None,
        "identity": info.identity,
        "max_structures": info.max_structures,
    }


def check_result(name: str, result: Any, place: np.ndarray) -> None:
    """ValueError if an array of an adapter cannot be written into its section."""
    import numpy as np

    if not isinstance(result, np.ndarray):
        raise ValueError(f"{name} is a {type(result).__name__}, expected a numpy array")
    if result.shape != place.shape:
        raise ValueError(f"{name} has the shape {result.shape}, expected {place.shape}")
    if result.dtype.kind != "f":
        raise ValueError(f"{name} has the type {result.dtype}, expected floating point")


def classify(error: BaseException) -> tuple[str, str]:
    """Kind and text of an error for its answer."""
    text = str(error) or "no message"
    if isinstance(error, InputError):
        return "input", text
    if is_out_of_memory(error):
        return "memory", f"out of memory ({type(error).__name__}: {text})"
    if isinstance(error, ModuleNotFoundError):
        return "import", f"the module '{error.name}' is missing in the environment {sys.prefix}"
    if isinstance(error, ImportError):
        return "import", f"an import failed in the environment {sys.prefix}: {text}"
    if isinstance(error, (AdapterError, ValueError)):
        return "exception", text
    return "exception", f"{type(error).__name__}: {text}"


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an error of any framework means that the device is out of memory."""
    if any(kind.__name__ in _OUT_OF_MEMORY for kind in type(error).__mro__):
        return True
    text = str(error)
    return isinstance(error, RuntimeError) and any(
        sign in text for sign in ("out of memory", "can't allocate memory", "RESOURCE_EXHAUSTED", "Out of memory")
    )


def one_line(text: str) -> str:
    """A text with all white space as single blanks, at most 600 characters."""
    line = " ".join(text.split())
    return line if len(line) <= 600 else line[:599] + "…"


def set_environment(threads: int, device: str) -> None:
    """Numbers of threads and visible devices, for all frameworks, which read them when they are imported."""
    for name in _THREAD_VARIABLES:
        os.environ[name] = str(threads)
    os.environ["TF_NUM_INTEROP_THREADS"] = "1"
    if device == "cpu":
        os.environ["CUDA_VISIBLE_DEVICES"] = ""


def take_streams() -> protocol.Connection:
    """Messages on copies of the first two file descriptors; these then are /dev/null and standard error."""
    incoming, outgoing = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    os.close(nothing)
    os.dup2(2, 1)
    return protocol.Connection(incoming, outgoing)


def _done(call: int, seconds: float, compiled: bool) -> dict[str, Any]:
    return {"status": "ok", "id": call, "seconds": seconds, "compiled": bool(compiled)}


def _end_with_parent() -> None:
    """Has the system kill this process when its parent is gone, also in the middle of a call (Linux: prctl, PR_SET_PDEATHSIG)."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)


def main() -> int:
    """Serves until the end of standard input."""
    # Ctrl-C and batch systems signal all processes; walkers finish their step, for which they need this one.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    _end_with_parent()
    connection = take_streams()
    server = Server()
    for line in connection.lines():
        try:
            connection.reply(server.answer(line))
        except BrokenPipeError:
            return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
