"""Measures a campaign at the size of a foundation model: time and memory of each command, and of the orchestrator.

    python make_model.py WORK          # once; needs gracemaker
    python measure.py CALMWALK WORK [SECONDS] [--seed-structures N]

CALMWALK is the program (release build). WORK has model.npz, gmm_artifacts.npz, seeds.extxyz and training.extxyz of
make_model.py. The campaign runs for SECONDS (default 240), is interrupted, and is continued for as long. With
--seed-structures it has the first N seed structures alone, in WORK/campaign-N. Python's standard library is enough.
"""

import argparse
import json
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from pathlib import Path

HERE = Path(__file__).resolve().parent


def finished(name, command, **options):
    """Runs a command to its end; prints its wall time, CPU time and peak memory. Returns its output."""
    began = time.monotonic()
    child = subprocess.Popen(command, stdout=subprocess.PIPE, **options)
    output = child.stdout.read()
    _, status, usage = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    wall, cpu, memory = time.monotonic() - began, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1e3
    print(f"{name:24} {wall:8.2f} s  {cpu:8.2f} s CPU  {memory:7.0f} MB  exit code {child.returncode}", flush=True)
    return output


def cpu_and_peak(pid):
    """CPU time in seconds and peak resident memory in MB of a process."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    ticks = os.sysconf("SC_CLK_TCK")
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    peak = next(int(line.split()[1]) for line in lines if line.startswith("VmHWM"))
    return (int(fields[11]) + int(fields[12])) / ticks, peak / 1e3


def children(pid):
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def state(calmwalk, directory):
    return json.loads(subprocess.run([calmwalk, "status", directory, "--json"], capture_output=True, check=True).stdout)


def decided(calmwalk, directory):
    """Number of decided candidates."""
    return state(calmwalk, directory)["candidates"]["seen"]


def run(name, calmwalk, config, directory, seconds):
    began = time.monotonic()
    log = open(directory.with_suffix(".log"), "a")
    child = subprocess.Popen([calmwalk, "run", config, "--directory", directory], stdout=log, stderr=log)
    while child.poll() is None and not any(
        cpu_and_peak(walker)[0] > 1.0 for walker in children(child.pid) if b"walker" in command_line(walker)
    ):
        time.sleep(0.05)
    cpu, peak = cpu_and_peak(child.pid)
    print(f"{name + ': start':24} {time.monotonic() - began:8.2f} s  {cpu:8.2f} s CPU  {peak:7.0f} MB", flush=True)
    before, cpu_before = decided(calmwalk, directory), cpu_and_peak(child.pid)[0]
    assignments_before, walkers_before = assignments(directory), cpu_of_walkers(child.pid)
    time.sleep(seconds)
    after, (cpu, peak) = decided(calmwalk, directory), cpu_and_peak(child.pid)
    made, used = assignments(directory) - assignments_before, cpu_of_walkers(child.pid) - walkers_before
    print(f"  {made} assignments in {seconds:.0f} s: {used / max(1, made):.2f} s CPU of a walker each")
    walkers = [cpu_and_peak(walker)[1] for walker in children(child.pid)]
    each = 1e3 * (cpu - cpu_before) / max(1, after - before)
    print(f"  {after - before} candidates in {seconds:.0f} s: {each:.1f} ms CPU of the orchestrator each; peak memory of the "
          f"orchestrator {peak:.0f} MB, of walkers {', '.join(f'{walker:.0f}' for walker in walkers)} MB")
    began = time.monotonic()
    child.send_signal(signal.SIGINT)
    child.wait()
    print(f"{name + ': interrupted':24} {time.monotonic() - began:8.2f} s  exit code {child.returncode}", flush=True)


def assignments(directory):
    """Number of assignments that walkers have reported on."""
    with sqlite3.connect(f"file:{directory / 'campaign.sqlite'}?mode=ro", uri=True) as database:
        return database.execute("SELECT COALESCE(SUM(assignments), 0) FROM walk").fetchone()[0]


def cpu_of_walkers(pid):
    return sum(cpu_and_peak(child)[0] for child in children(pid) if b"walker" in command_line(child))


def command_line(pid):
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except FileNotFoundError:
        return b""


def first_frames(text, number):
    """The first frames of an extended XYZ file."""
    lines, end = text.splitlines(keepends=True), 0
    for frame in range(number):
        if end >= len(lines):
            sys.exit(f"seeds.extxyz has {frame} seed structures, fewer than {number}")
        end += int(lines[end]) + 2
    return "".join(lines[:end])


def write_config(work, number):
    """Writes the configuration, with the first `number` seed structures or all. Returns its path."""
    text = (HERE / "campaign.toml").read_text()
    if number is None:
        config = work / "campaign.toml"
    else:
        config, seeds = work / f"campaign-{number}.toml", f"seeds-{number}.extxyz"
        (work / seeds).write_text(first_frames((work / "seeds.extxyz").read_text(), number))
        assert '"seeds.extxyz"' in text
        text = text.replace('"seeds.extxyz"', f'"{seeds}"')
    config.write_text(text)
    return config


def views(calmwalk, directory):
    """Measures the commands that only read."""
    finished("status", [calmwalk, "status", directory])
    finished("status --all", [calmwalk, "status", directory, "--all"])
    finished("status --json", [calmwalk, "status", directory, "--json"])
    finished("report", [calmwalk, "report", directory, "--output", directory.with_name(directory.name + "-report")])


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("calmwalk", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument("seconds", type=float, nargs="?", default=240.0)
    parser.add_argument("--seed-structures", type=int, metavar="N", help="the first N seed structures alone")
    arguments = parser.parse_args()
    calmwalk, work, seconds = arguments.calmwalk.resolve(), arguments.work.resolve(), arguments.seconds
    config = write_config(work, arguments.seed_structures)
    directory = config.with_suffix("")
    shutil.rmtree(directory, ignore_errors=True)
    finished("validate", [calmwalk, "validate", config])
    run("first run", calmwalk, config, directory, seconds)
    views(calmwalk, directory)
    run("restarted", calmwalk, config, directory, seconds)
    views(calmwalk, directory)
    finished("store check", [calmwalk, "store", "check", directory])
    size = sum(file.stat().st_size for file in directory.rglob("*") if file.is_file())
    print(f"the campaign's directory has {size / 1e6:.0f} MB")


if __name__ == "__main__":
    main()
