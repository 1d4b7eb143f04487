# A single point with an ASE calculator: reads input.json and calculator.py, writes result.json.
#
# result.json is written atomically at the end. The output of the calculator goes to stdout. Without input.json, the
# script prints the versions of ASE and of calculator.py.

import importlib.util
import inspect
import sys
import traceback

import ase
from ase import Atoms
from ase.calculators.calculator import PropertyNotImplementedError
from ase.parallel import world

# A property that the calculator does not implement.
ABSENT = (PropertyNotImplementedError, NotImplementedError, AttributeError)


def main():
    user = load("calculator.py")
    versions = {"ase": ase.__version__, "version": str(getattr(user, "version", ""))}
    try:
        with open("input.json") as file:
            task = json.load(file)
    except FileNotFoundError:
        return say(versions)

    atoms = Atoms(task["species"], positions=task["positions"], cell=task["cell"], pbc=task["periodic"])
    if task["moments"] is not None:
        atoms.set_initial_magnetic_moments(task["moments"])
    try:
        takes_adjustments = len(inspect.signature(user.calculator).parameters) > 0
        atoms.calc = user.calculator(set(task["retry_adjustments"])) if takes_adjustments else user.calculator()
        result = calculate(atoms, user)
    except Exception as error:
        traceback.print_exc()
        result = failure(kind(error), f"{type(error).__name__}: {error}")
    leave(result, versions)


def load(name):
    specification = importlib.util.spec_from_file_location("calmwalk_calculator", os.path.abspath(name))
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    if not callable(getattr(module, "calculator", None)):
        sys.exit("the calculator's file defines no function calculator()")
    return module


def calculate(atoms, user):
    energy = atoms.get_potential_energy()
    # Forces are derivatives of the free energy, if the calculator distinguishes the two energies.
    free = optional(lambda: atoms.get_potential_energy(force_consistent=True))
    forces = atoms.get_forces()
    stress = optional(lambda: atoms.get_stress()) if atoms.pbc.all() else None
    if converged(atoms.calc, user) is False:
        return failure("not_converged", "the calculator returns numbers but reports that it did not converge")
    calculated = getattr(atoms.calc, "atoms", None) or atoms
    results = getattr(atoms.calc, "results", None) or {}
    moments, magnetisation = results.get("magmoms"), results.get("magmom")
    result = {
        "species": calculated.get_chemical_symbols(),
        "positions": calculated.positions.tolist(),
        "cell": calculated.cell[:].tolist(),
        "energy": float(energy if free is None else free),
        "energy_without_smearing": None if free is None else float(energy),
        "forces": forces.tolist(),
        "stress": None if stress is None else stress.tolist(),
        "moments": None if moments is None else [float(moment) for moment in moments],
        "magnetisation": None if magnetisation is None else float(magnetisation),
        "steps": optional(lambda: int(atoms.calc.get_number_of_iterations())),
    }
    if not all(map(math.isfinite, numbers(result))):
        return failure("implausible", "a number of the result is not finite")
    return {"converged": result}


def optional(value):
    try:
        return value()
    except ABSENT + (TypeError,):
        return None


def converged(calculator, user):
    """True, False or None (unknown). The user's own function converged(calculator) takes precedence."""
    if hasattr(user, "converged"):
        return bool(user.converged(calculator))
    for owner in (calculator, getattr(calculator, "scf", None)):
        said = getattr(owner, "converged", None)
        if said is not None:
            said = optional(said) if callable(said) else said
            return None if said is None else bool(said)
    return None


def kind(error):
    """The failure class of an exception. Exceptions of calculators are recognised by their names."""
    names = {parent.__name__ for parent in type(error).__mro__}
    if "SCFError" in names or any("Convergence" in name for name in names):
        return "not_converged"
    if "MemoryError" in names or "OutOfMemoryError" in names:
        return "out_of_memory"
    if names & {"CalculatorSetupError", "InputError", "AtomsTooClose"}:
        return "bad_input"
    return "crashed"


main()
