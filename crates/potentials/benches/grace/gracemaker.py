"""Times gracemaker's own calculator with one thread: python gracemaker.py request.json

The request names structures, and either a checkpoint or a preset of which a model with random weights is made (the time does
not depend on them), and the precision, "double" or "single". For every line "plain K" or "graded K" of its input
one call is made with structure K, energy and forces or, where there is a mixture, the same with γ and the gradient of Σγ, and
a line "seconds S" is printed.
"""

import json
import os
import sys
import tempfile
import time

os.environ["TF_CPP_MIN_LOG_LEVEL"] = "3"

import numpy as np
import tensorflow as tf
from ase import Atoms
from tensorpotential.calculator import TPCalculator
from tensorpotential.potentials import get_preset
from tensorpotential.tensorpot import TensorPotential
from tensorpotential.tpmodel import ComputeStructureEnergyAndForcesAndVirial
from tensorpotential.instructions.base import load_instructions, save_instructions_dict
from tensorpotential.uq.factories import get_gmm_uq_calculator

tf.config.threading.set_intra_op_parallelism_threads(1)
tf.config.threading.set_inter_op_parallelism_threads(1)


def model_files(request, dtype, folder):
    """Paths of model.yaml and checkpoint. A checkpoint is in double precision; in single precision its weights are random too."""
    if "checkpoint" in request:
        model = request["checkpoint"] + "/model.yaml"
        if dtype == tf.float64:
            return model, request["checkpoint"] + "/checkpoint"
        instructions = load_instructions(model)
    else:
        elements = {symbol: index for index, symbol in enumerate(request["elements"])}
        preset = get_preset(request["preset"])
        model = folder + "/model.yaml"
        instructions = preset(element_map=elements, rcut=request["cutoff"], **request["arguments"]).get_instructions()
        save_instructions_dict(model, instructions)
    potential = TensorPotential(instructions, param_dtype=dtype)
    potential.save_checkpoint(checkpoint_name=folder + "/checkpoint")
    return model, folder + "/checkpoint"


def plain_calculator(model, checkpoint, dtype):
    potential = TensorPotential(
        load_instructions(model),
        model_compute_function=ComputeStructureEnergyAndForcesAndVirial(),
        param_dtype=dtype,
    )
    potential.load_checkpoint(checkpoint, model_only=True, assert_consumed=False, expect_partial=True)
    potential.model.decorate_compute_function()
    return TPCalculator(potential.model)


class Case:
    """A structure whose positions differ slightly from call to call."""

    def __init__(self, structure, calculators):
        self.atoms = Atoms(structure["symbols"], positions=structure["positions"], cell=structure["cell"], pbc=True)
        self.calculators = calculators
        self.random = np.random.default_rng(1)
        self.compiled = set()

    def seconds(self, name):
        """Time of one call after compilation. Short calls run twice, so that their data are in the caches."""
        if name not in self.compiled:
            self.compiled.add(name)
            for _ in range(4):
                self.call(name)
        first = self.call(name)
        return first if first > 1.0 else self.call(name)

    def call(self, name):
        self.atoms.positions += self.random.normal(0.0, 1e-3, self.atoms.positions.shape)
        start = time.perf_counter()
        self.calculators[name].calculate(self.atoms, properties=["energy", "forces"])
        return time.perf_counter() - start


def main():
    with open(sys.argv[1]) as file:
        request = json.load(file)
    dtype = {"double": tf.float64, "single": tf.float32}[request["precision"]]
    with tempfile.TemporaryDirectory() as folder:
        model, checkpoint = model_files(request, dtype, folder)
        calculators = {"plain": plain_calculator(model, checkpoint, dtype)}
        if "artifact" in request:
            calculators["graded"] = get_gmm_uq_calculator(model, checkpoint, request["artifact"], dtype)
        cases = [Case(structure, calculators) for structure in request["structures"]]
        for line in sys.stdin:
            name, case = line.split()
            print("seconds", cases[int(case)].seconds(name), flush=True)


main()
