"""The radial model behind a simulated device, for tests of batching, deadlines and faults.

A call ends `base_seconds` + `seconds_per_structure` × structures after it began, however fast the processor is.

Options, all with a default that does nothing:

- `base_seconds`, `seconds_per_structure`: the time of a call
- `compile_seconds`: more time for the first evaluate and pull_back of each shape, which then report `compiled`;
  implies `padding`
- `padding`: ask for padded batches
- `max_structures`: what hello reports
- `memory_above`: a call with more structures than this is out of memory
- `fault`, `fault_call`, `fault_at`: a fault at the n-th call (from 1) of a kind: hello, evaluate (default),
  evaluate_without_forces or pull_back
- `exit_at_atoms`: the process ends with status 3 at a call with a structure of so many atoms
- `control`: path of a file, looked for at each evaluate and pull_back. It has a fault a line; it is removed when it
  is read, and its faults happen at this and the next calls, one at each. "memory_above 8" and "base_seconds 0.5" set
  these options and are no faults.
- `count`: path of a file to which each call appends a line: kind, structures, atoms, bonds (with padding), real
  structures
- `bend`: {"forces": 1.1, …} multiplies a result (forces, virials, gradients, gradient_virials) by a factor: a model
  with wrong derivatives; `features` those of an evaluation without forces
- `noise`: relative noise of the energies, another in each call: a model that is not deterministic
- `order`: energies differ by this times the atom's index: a model that permutations change
- `crowd`, `crowd_gradients`: energies, or gradients, differ by this times the number of structures beyond
  `crowd_above`: a model that the composition of a batch changes

Faults: "exit" (the process ends with status 3), "hang" (sleeps without end), "slow" (ten seconds more), "nan" (the
first force, gradient, or, without forces, feature is not a number), "shape" (these of one atom less), "type" (of whole
numbers), "exception", "memory", "import" (of a module that does not exist), "print" (writes to standard output, which
must not harm).
"""

from __future__ import annotations

import dataclasses
import importlib
import os
import time
from collections import Counter, deque
from pathlib import Path
from typing import Any, Optional

import numpy as np

from ..adapter import Energies, Evaluation, Gradients, check_options
from ..batch import Batch
from ..errors import InputError
from .radial import Radial

FAULTS = ("exit", "hang", "slow", "nan", "shape", "type", "exception", "memory", "import", "print")
_DEFAULTS: dict[str, Any] = {
    "base_seconds": 0.0,
    "seconds_per_structure": 0.0,
    "compile_seconds": 0.0,
    "padding": False,
    "max_structures": None,
    "memory_above": None,
    "fault": None,
    "fault_call": "evaluate",
    "fault_at": 1,
    "exit_at_atoms": None,
    "control": None,
    "count": None,
    "bend": {},
    "noise": 0.0,
    "order": 0.0,
    "crowd": 0.0,
    "crowd_gradients": 0.0,
    "crowd_above": 0,
}


class Simulated:
    """The adapter."""

    def __init__(
        self,
        model: Optional[Path],
        options: dict[str, Any],
        device: str = "cpu",
        precision: str = "double",
        threads: int = 1,
        cache: Optional[Path] = None,
    ) -> None:
        check_options(options, _DEFAULTS)
        self._options = {**_DEFAULTS, **options}
        self._calls: Counter[str] = Counter()
        self._shapes: set[tuple[str, int, int, int]] = set()
        self._pending: deque[str] = deque()
        self._random = np.random.default_rng()
        if self._options["fault"] not in (None, *FAULTS):
            raise InputError(f"the option 'fault' is {self._options['fault']!r}, expected one of {', '.join(FAULTS)}")
        self._strike("hello")
        self._radial = Radial(model, {}, device, precision, threads, cache)
        self.info = dataclasses.replace(
            self._radial.info,
            device=device,
            max_structures=self._options["max_structures"],
            padding=bool(self._options["padding"] or self._options["compile_seconds"]),
        )

    def evaluate(self, batch: Batch, features: bool) -> Evaluation:
        started = time.monotonic()
        fault, compiled = self._begin("evaluate", batch)
        result = self._radial.evaluate(batch, features)
        bend = self._options["bend"]
        result.forces = _spoil(fault, result.forces * bend.get("forces", 1.0))
        result.virials = result.virials * bend.get("virials", 1.0)
        result.energies = self._disturb(result.energies, batch)
        result.compiled = compiled
        self._end(started, batch, compiled)
        return result

    def evaluate_without_forces(self, batch: Batch) -> Energies:
        started = time.monotonic()
        fault, compiled = self._begin("evaluate_without_forces", batch)
        result = self._radial.evaluate_without_forces(batch)
        result.features = _spoil(fault, result.features * self._options["bend"].get("features", 1.0))
        result.energies = self._disturb(result.energies, batch)
        result.compiled = compiled
        self._end(started, batch, compiled)
        return result

    def pull_back(
        self, batch: Batch, feature_cotangents: np.ndarray, energy_cotangents: Optional[np.ndarray] = None
    ) -> Gradients:
        started = time.monotonic()
        fault, compiled = self._begin("pull_back", batch)
        result = self._radial.pull_back(batch, feature_cotangents, energy_cotangents)
        bend = self._options["bend"]
        result.gradients = _spoil(fault, result.gradients * bend.get("gradients", 1.0))
        if self._options["crowd_gradients"] and self._crowd(batch):
            result.gradients = result.gradients + self._options["crowd_gradients"] * self._crowd(batch)
        result.virials = result.virials * bend.get("gradient_virials", 1.0)
        result.compiled = compiled
        self._end(started, batch, compiled)
        return result

    def _begin(self, call: str, batch: Batch) -> tuple[Optional[str], bool]:
        """The fault of a call that its result shows, and whether its shape is new."""
        self._note(call, batch)
        fault = self._strike(call)
        if self._options["exit_at_atoms"] in np.bincount(batch.structure_of_atom):
            os._exit(3)
        limit = self._options["memory_above"]
        if limit is not None and batch.real.structures > limit:
            raise MemoryError(f"{batch.real.structures} structures in a batch, room for {limit}")
        shape = (call, batch.n_structures, batch.n_atoms, batch.n_bonds)
        compiled = self.info.padding and shape not in self._shapes
        self._shapes.add(shape)
        return fault, compiled

    def _end(self, started: float, batch: Batch, compiled: bool) -> None:
        options = self._options
        seconds = options["base_seconds"] + options["seconds_per_structure"] * batch.real.structures
        if compiled:
            seconds += options["compile_seconds"]
        time.sleep(max(0.0, started + seconds - time.monotonic()))

    def _strike(self, call: str) -> Optional[str]:
        """Lets the fault of this call happen, or returns it if the result must show it."""
        self._calls[call] += 1
        options = self._options
        if call != "hello":
            self._read_control()
        fault = self._pending.popleft() if self._pending else None
        if fault is None and options["fault_call"] == call and options["fault_at"] == self._calls[call]:
            fault = options["fault"]
        if fault is not None:
            _happen(fault)
        return fault

    def _read_control(self) -> None:
        path = self._options["control"]
        if path is None:
            return
        taken = f"{path}.{os.getpid()}"
        try:
            os.rename(path, taken)
        except FileNotFoundError:
            return
        lines = Path(taken).read_text().split("\n")
        os.remove(taken)
        for line in filter(None, map(str.strip, lines)):
            name, _, value = line.partition(" ")
            if name == "memory_above":
                self._options[name] = int(value) if value else None
            elif name == "base_seconds":
                self._options[name] = float(value)
            elif name in FAULTS:
                self._pending.append(name)
            else:
                raise InputError(f"{path}: '{line}' is no fault; the faults are {', '.join(FAULTS)}")

    def _note(self, call: str, batch: Batch) -> None:
        if self._options["count"] is not None:
            with open(self._options["count"], "a") as file:
                sizes = f"{batch.n_structures} {batch.n_atoms} {batch.n_bonds} {batch.real.structures}"
                file.write(f"{call} {sizes}\n")

    def _disturb(self, energies: np.ndarray, batch: Batch) -> np.ndarray:
        options = self._options
        if options["noise"]:
            energies = energies * (1 + options["noise"] * self._random.standard_normal(len(energies)))
        if options["order"]:
            energies = energies + options["order"] * np.arange(len(energies))
        if options["crowd"]:
            energies = energies + options["crowd"] * self._crowd(batch)
        return energies

    def _crowd(self, batch: Batch) -> int:
        return max(0, batch.n_structures - self._options["crowd_above"])


def _happen(fault: str) -> None:
    if fault == "exit":
        os._exit(3)
    while fault == "hang":
        time.sleep(3600)
    if fault == "slow":
        time.sleep(10)
    if fault == "exception":
        raise ZeroDivisionError("a fault that was asked for")
    if fault == "memory":
        raise MemoryError("a fault that was asked for")
    if fault == "import":
        importlib.import_module("calmwalk_missing_module")
    if fault == "print":
        os.write(1, b"a library prints to standard output\n")


def _spoil(fault: Optional[str], result: np.ndarray) -> np.ndarray:
    if fault == "nan":
        result = result.copy()
        result[0, 0] = np.nan
    if fault == "shape":
        return result[:-1]
    if fault == "type":
        return result.astype(np.int64)
    return result
