"""Times gracemaker's own calculator on one core: python gracemaker.py REQUEST.json

The request names a structure, and either a checkpoint or a preset of which a model with random weights is made (the time does
not depend on them), and the precision, "double" or "single". Prints the seconds of each call as JSON: energy and forces, and, where there is a mixture, the same with γ
and the gradient of Σγ.
"""

import json
import os
import sys
import tempfile
import time

os.environ["TF_CPP_MIN_LOG_LEVEL"] = "3"
os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})

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
    """Paths of model.yaml and checkpoint. A checkpoint is in double precision: in single its weights are random too."""
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


def seconds(calculator, atoms, repetitions):
    """Of each call, at positions that differ a little, after the calls that compile."""
    random = np.random.default_rng(1)
    found = []
    for k in range(repetitions + 4):
        atoms.positions += random.normal(0.0, 1e-3, atoms.positions.shape)
        start = time.perf_counter()
        calculator.calculate(atoms, properties=["energy", "forces"])
        found.append(time.perf_counter() - start)
    return found[4:]


def main():
    with open(sys.argv[1]) as file:
        request = json.load(file)
    dtype = {"double": tf.float64, "single": tf.float32}[request["precision"]]
    with tempfile.TemporaryDirectory() as folder:
        model, checkpoint = model_files(request, dtype, folder)
        plain = plain_calculator(model, checkpoint, dtype)
        graded = "artifact" in request and get_gmm_uq_calculator(model, checkpoint, request["artifact"], dtype)
        answer = []
        for s in request["structures"]:
            atoms = Atoms(s["symbols"], positions=s["positions"], cell=s["cell"], pbc=True)
            times = {"atoms": len(atoms)}
            times["plain"] = seconds(plain, atoms, request["repetitions"])
            times["graded"] = seconds(graded, atoms, request["repetitions"]) if graded else []
            answer.append(times)
    print(json.dumps(answer))


main()
