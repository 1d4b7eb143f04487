"""Code shared by the scripts of both methods. The script itself follows."""

import json
import math
import os


def numbers(result):
    if isinstance(result, dict):
        result = list(result.values())
    if isinstance(result, list):
        for part in result:
            yield from numbers(part)
    elif isinstance(result, float):
        yield result


def failure(kind, message):
    return {"failure": {"class": kind, "message": message}}


def say(result):
    if world.rank == 0:
        print(json.dumps(result), flush=True)


def leave(result, by):
    """The result with the versions of the programs that made it."""
    if world.rank == 0:
        with open("result.json.part", "w") as file:
            json.dump({**result, "by": by}, file)
            file.flush()
            os.fsync(file.fileno())
        os.replace("result.json.part", "result.json")


