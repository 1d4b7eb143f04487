# A plane-wave single point with GPAW: reads input.json, writes result.json.
#
# result.json is written atomically at the end. The output of GPAW goes to stdout. Without input.json, the script prints
# the version of GPAW and its search path for setups.

import ase
import gpaw
from ase import Atoms
from gpaw import GPAW, PW, KohnShamConvergenceError
from gpaw.mpi import world
from gpaw.utilities import AtomsTooClose


def main():
    versions = {"gpaw": gpaw.__version__, "ase": ase.__version__}
    try:
        with open("input.json") as file:
            task = json.load(file)
    except FileNotFoundError:
        paths = [str(path) for path in gpaw.setup_paths]
        return say({**versions, "setup_paths": paths})

    gpaw.setup_paths[:] = [task["setups"]]
    calculator = GPAW(mode=PW(task["cutoff"]), **task["parameters"])
    atoms = Atoms(task["species"], positions=task["positions"], cell=task["cell"], pbc=True, calculator=calculator)
    atoms.set_initial_magnetic_moments(task["moments"])
    try:
        result = calculate(atoms, spin=task["moments"] is not None)
    except KohnShamConvergenceError as error:
        steps = getattr(calculator.scf, "niter", None)
        result = failure("not_converged", f"{error} ({steps} electronic steps)")
    except AtomsTooClose as error:
        result = failure("bad_input", str(error))
    except MemoryError as error:
        result = failure("out_of_memory", str(error))
    leave(result, versions)


def calculate(atoms, spin):
    calculator = atoms.calc
    # Forces are derivatives of the free energy.
    result = {"energy": calculator.get_potential_energy(atoms, force_consistent=True)}
    if not calculator.scf.converged:
        return failure("not_converged", "GPAW returns an energy but does not report convergence")
    result["energy_without_smearing"] = calculator.get_potential_energy(atoms, force_consistent=False)
    result["forces"] = calculator.get_forces(atoms).tolist()
    result["stress"] = calculator.get_stress(atoms).tolist()
    result["moments"] = calculator.get_magnetic_moments(atoms).tolist() if spin else None
    result["magnetisation"] = calculator.get_magnetic_moment(atoms) if spin else None
    result["steps"] = calculator.get_number_of_iterations()
    calculated = calculator.get_atoms()
    result["species"] = calculated.get_chemical_symbols()
    result["positions"] = calculated.positions.tolist()
    result["cell"] = calculated.cell[:].tolist()
    if not all(map(math.isfinite, numbers(result))):
        return failure("implausible", "a number of the result is not finite")
    return {"converged": result}


main()
