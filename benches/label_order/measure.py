"""Compares both orders of labels by what a potential learns from the first of them.

    python measure.py CALMWALK CAMPAIGN MODEL MIXTURE OLD [--seeds 0 1 2] [--epochs N] [--shares 0.25 0.5 0.75] [--upfit OPTIONS…]

CAMPAIGN is a finished campaign whose structures have all labels, run without [refit]; configs/aluminium.toml without its section
[refit] makes one. MODEL and MIXTURE are those of its configuration, OLD is extended XYZ of old training data, which every training
set has (the replay of a refit). The orders come from `cargo bench --bench label_order`, which holds out a random quarter of the walks for
each seed. Failed calculations cost labels: the first 25 % are those of all calculations.

Each training takes a fixed number of epochs, with the options of `calmwalk upfit` behind `--upfit`, and its last weights: nothing is
selected by the held-out labels. The held-out error is measured by another `upfit` of the trained model on the held-out labels, whose
errors `before` are those of its model after the shift of each element was fitted. Prints a table of the held-out force MAE (eV/Å per
component) by order, share and seed, and the mean over seeds.
"""

import argparse
import json
import statistics
import subprocess
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def run(*command):
    done = subprocess.run([str(word) for word in command], capture_output=True, text=True, cwd=ROOT)
    if done.returncode:
        raise SystemExit(f"{' '.join(map(str, command))}\n{done.stdout}{done.stderr}")
    return done.stdout


def orders(options, seed):
    files = [Path(path).resolve() for path in (options.campaign, options.model, options.mixture)]
    text = run("cargo", "bench", "--quiet", "--bench", "label_order", "--", *files, "--seed", seed)
    return json.loads(text.splitlines()[-1])


def frames(path):
    """The frames of an extended XYZ file as text, by candidate."""
    lines, found, place = path.read_text().splitlines(keepends=True), {}, 0
    while place < len(lines):
        end = place + 2 + int(lines[place])
        comment = lines[place + 1]
        name = comment.split("candidate_id=", 1)[1].split()[0].strip('"')
        found[name] = "".join(lines[place:end])
        place = end
    return found


def write(path, all_frames, names):
    chosen = [all_frames[name] for name in names if name in all_frames]
    path.write_text("".join(chosen))
    return len(chosen)


def force_error(options, model, held_out, scratch):
    text = run(options.calmwalk, "upfit", "--model", model, held_out, "--validation-share", 0, "--epochs", 1,
               "--output", scratch / "scored.npz", "--json")
    return json.loads(text)["before"]["training"]["force_mae"]


def train(options, data, output):
    run(options.calmwalk, "upfit", "--model", options.model, options.old, data, "--validation-share", 0,
        "--epochs", options.epochs, "--output", output, "--json", *options.upfit)
    return output


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("calmwalk", "campaign", "model", "mixture", "old"):
        parser.add_argument(name)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--shares", type=float, nargs="+", default=[0.25, 0.5, 0.75])
    parser.add_argument("--epochs", type=int, default=100)
    parser.add_argument("--upfit", nargs=argparse.REMAINDER, default=[])
    options = parser.parse_args()
    for name in ("calmwalk", "campaign", "model", "mixture", "old"):
        setattr(options, name, Path(getattr(options, name)).resolve())
    errors = {}
    with tempfile.TemporaryDirectory() as directory:
        scratch = Path(directory)
        run(options.calmwalk, "export", options.campaign, "--control", "--output", scratch / "all.extxyz")
        labelled = frames(scratch / "all.extxyz")
        for seed in options.seeds:
            replay = orders(options, seed)
            held_out = scratch / "held_out.extxyz"
            number = write(held_out, labelled, replay["held_out"])
            before = force_error(options, options.model, held_out, scratch)
            print(f"seed {seed}: {number} held-out labels, force MAE before training {before:.4f}", flush=True)
            for order in ("found", "value"):
                made = replay[order]
                for share in options.shares:
                    first = [row["candidate"] for row in made[:round(share * len(made))] if row["labelled"]]
                    data = scratch / f"{order}-{share}-{seed}.extxyz"
                    number = write(data, labelled, first)
                    model = train(options, data, scratch / f"{order}-{share}-{seed}.npz")
                    errors[order, share, seed] = force_error(options, model, held_out, scratch)
                    print(f"  {order:5} {share:4.0%} {number:4} labels  {errors[order, share, seed]:.4f}", flush=True)
    print("\n| calculations | order | " + " | ".join(f"seed {seed}" for seed in options.seeds) + " | mean |")
    print("| --- " * (len(options.seeds) + 3) + "|")
    for share in options.shares:
        for order in ("found", "value"):
            row = [errors[order, share, seed] for seed in options.seeds]
            print(f"| {share:.0%} | {order} | " + " | ".join(f"{error:.4f}" for error in row) + f" | {statistics.mean(row):.4f} |")


if __name__ == "__main__":
    main()
