"""A small real campaign for tests: two walks of aluminium, labels by an embedded-atom potential, one import."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
_DATA = ROOT / "configs" / "data"

_CONFIG = """
[campaign]
mode = "reproducible"
rng_seed = 7
[potential]
model = "{data}/al_eam_1l/kokkos.npz"
[calm]
artifact = "{data}/al_eam_1l/gmm_artifacts.npz"
training_frames = "{data}/al_eam_1l/seed_frames.extxyz"
[seed_structures]
files = ["seeds.extxyz"]
[walk]
temperature = 700.0
biased_steps = 240
equilibration_steps = 20
tau = 0.3
volume_ramp = {{ from = 1.0, to = 1.25 }}
[collect]
criterion = {{ rule = "atom_count", threshold = 1.0, fraction = 0.1 }}
update_target = {{ rule = "atom_count", threshold = 1.0, fraction = 0.1, target = 1.25 }}
min_interval = 30
min_interval_after_decline = 5
max_per_walk = 4
[guard]
zbl = {{ rule = "uniform", inner = 1.6, outer = 2.4 }}
[label]
method = {{ potential = {{ kind = "eam_fs", file = "{data}/Al_mm.eam.fs" }} }}
[run]
walkers = 2
walks_per_round = 2
steps_per_assignment = 40
{store}
"""


def program() -> str | None:
    """The binary: `CALMWALK_BINARY`, else a build of this checkout, else the one on the path."""
    if found := os.environ.get("CALMWALK_BINARY"):
        return found
    builds = [ROOT / "target" / profile / "calmwalk" for profile in ("release", "debug")]
    built = [build for build in builds if build.exists()]
    return str(max(built, key=lambda build: build.stat().st_mtime)) if built else shutil.which("calmwalk")


def make(directory: Path, store: str = "") -> str:
    """Run the campaign and import a labelled structure into it. Returns its location."""
    frames = _frames(_DATA / "aluminium_seeds.extxyz")
    seeds = [frame for frame in frames if "name=fcc-100 " in frame or "name=vacancy " in frame]
    (directory / "seeds.extxyz").write_text("".join(seeds))
    config = directory / "campaign.toml"
    config.write_text(_CONFIG.format(data=_DATA, store=f'store = "{store}"' if store else ""))
    run("run", str(config), "--in-process")
    location = store or str(directory / "campaign")
    imported = directory / "imported.extxyz"
    imported.write_text(
        '2\nLattice="4.05 0 0 0 4.05 0 0 0 4.05" Properties=species:S:1:pos:R:3:forces:R:3 energy=-5.5 '
        'stress="0.01 0.001 0.002 0.001 0.02 0.003 0.002 0.003 0.03" pbc="T T T"\n'
        "Al 0 0 0 0.1 0.2 -0.3\nAl 2.025 2.025 0 -0.1 -0.2 0.3\n"
    )
    run("import", location, str(imported))
    return location


def run(*arguments: str) -> str:
    """Run the binary and return its output; an error has what it printed."""
    done = subprocess.run([str(program()), *arguments], capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"calmwalk {' '.join(arguments)} failed: {done.stdout}{done.stderr}")
    return done.stdout


def _frames(path: Path) -> list[str]:
    """The frames of an extended XYZ file as text."""
    lines, found = path.read_text().splitlines(keepends=True), []
    while lines:
        count = int(lines[0]) + 2
        found.append("".join(lines[:count]))
        lines = lines[count:]
    return found
