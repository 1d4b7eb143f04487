"""The other side of the protocol, as calmwalk plays it, for tests."""

from __future__ import annotations

import itertools
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, Optional

import numpy as np

from calmwalk.arenas import _INPUTS, _OTHERS, ALIGNMENT
from calmwalk.batch import Batch

PACKAGE = Path(__file__).resolve().parent.parent
DATA = Path(__file__).resolve().parent / "data"
SHARED_MEMORY = "/dev/shm" if os.path.isdir("/dev/shm") else None


class Client:
    """A server in a process of its own."""

    def __init__(self, python: str = sys.executable) -> None:
        environment = {**os.environ, "PYTHONPATH": str(PACKAGE)}
        self.process = subprocess.Popen(
            [python, "-m", "calmwalk.server"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env=environment,
        )
        self._ids = itertools.count(1)
        self._arenas: dict[int, SharedFile] = {}
        self.dimension = 0

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        for stream in (self.process.stdin, self.process.stdout):
            stream.close()
        self.process.wait(30)
        self.process.stderr.close()
        for arena in self._arenas.values():
            arena.remove()

    def send(self, message: Any) -> None:
        """One message without waiting for its answer."""
        line = message if isinstance(message, bytes) else json.dumps(message).encode()
        self.process.stdin.write(line + b"\n")
        self.process.stdin.flush()

    def receive(self) -> dict[str, Any]:
        """The next answer."""
        return json.loads(self.process.stdout.readline())

    def ask(self, message: Any) -> dict[str, Any]:
        self.send(message)
        return self.receive()

    def hello(self, adapter: str, model: Optional[Path], **more: Any) -> dict[str, Any]:
        message = {"call": "hello", "protocol": 1, "adapter": adapter, "model": None if model is None else str(model)}
        message.update({"options": {}, "device": "cpu", "precision": "double", "threads": 1, "cache": None, **more})
        answer = self.ask(message)
        self.dimension = answer.get("features", {}).get("dimension", 0)
        return answer

    def call(
        self,
        name: str,
        batch: Batch,
        arena: int = 0,
        topology: int = 1,
        cotangents: Optional[np.ndarray] = None,
        energy: Optional[np.ndarray] = None,
        kept: Optional[int] = None,
        features: bool = True,
        forces: bool = True,
    ) -> int:
        """Sends evaluate or pull_back; returns its id."""
        identifier = next(self._ids)
        inputs = {key: getattr(batch, key) for key in _INPUTS}
        if name == "pull_back":
            inputs["feature_cotangents"] = cotangents
            if energy is not None:
                inputs["energy_cotangents"] = energy
        outputs = ["energies"] + (["forces", "virials"] if forces else []) + (["features"] if features else [])
        shared = self._arenas.setdefault(arena, SharedFile())
        shared.fill(
            batch, self.dimension, inputs, ["gradients", "gradient_virials"] if name == "pull_back" else outputs
        )
        message = {
            "call": name,
            "id": identifier,
            "arena": arena,
            "path": shared.path,
            "bytes": shared.bytes,
            "structures": batch.n_structures,
            "atoms": batch.n_atoms,
            "bonds": batch.n_bonds,
            "real": vars(batch.real),
            "topology": topology,
            "sections": shared.offsets,
        }
        wanted = {"features": features} if forces else {"features": features, "forces": False}
        message.update({"kept": kept, "energy": energy is not None} if name == "pull_back" else wanted)
        self.send(message)
        return identifier

    def results(self, arena: int = 0) -> dict[str, np.ndarray]:
        """Copies of the outputs of an arena."""
        return self._arenas[arena].outputs()


class SharedFile:
    """An arena."""

    def __init__(self) -> None:
        descriptor, self.path = tempfile.mkstemp(prefix="calmwalk-test-", dir=SHARED_MEMORY)
        os.close(descriptor)
        self.bytes = 0
        self.offsets: dict[str, int] = {}
        self._outputs: dict[str, np.ndarray] = {}

    def fill(self, batch: Batch, dimension: int, inputs: dict[str, np.ndarray], outputs: list[str]) -> None:
        shape = {"S": batch.n_structures, "A": batch.n_atoms, "B": batch.n_bonds, "D": dimension}
        arrays = dict(inputs)
        for name in outputs:
            dtype, letters = _OTHERS[name]
            arrays[name] = np.full([shape.get(letter, letter) for letter in letters], np.nan, dtype)
        self.offsets, end = {}, 0
        for name, array in arrays.items():
            self.offsets[name] = end
            end += -(-array.nbytes // ALIGNMENT) * ALIGNMENT
        self.bytes = max(self.bytes, end)
        with open(self.path, "r+b") as file:
            file.truncate(self.bytes)
        whole = np.memmap(self.path, np.uint8, "r+", shape=(self.bytes,))
        views = {name: _view(whole, self.offsets[name], array) for name, array in arrays.items()}
        for name, array in arrays.items():
            views[name][...] = array
        self._outputs = {name: views[name] for name in outputs}

    def outputs(self) -> dict[str, np.ndarray]:
        return {name: view.copy() for name, view in self._outputs.items()}

    def remove(self) -> None:
        os.unlink(self.path)


def _view(whole: np.ndarray, offset: int, array: np.ndarray) -> np.ndarray:
    return whole[offset : offset + array.nbytes].view(array.dtype).reshape(array.shape)
