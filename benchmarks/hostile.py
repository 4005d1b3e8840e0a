"""An attack on the toolkit, counted by outcome; the same seed repeats it.

    python benchmarks/hostile.py --seed 1                            # the acceptance run: about half an hour
    python benchmarks/hostile.py --seed 1 --only texts --count 1000

damage  Larger damage to the same files, also with a SHA-256 that was lost or computed again.
flips   Single bits of files of every kind and of a study's blocks.
texts   Mutated manifests, tables, arms (URDF, MJCF, controllers' files too), specifications and certificates.
headers Tables whose header contradicts the manifest in unit or order, or is misspelt.
structure  One name misspelt or repeated: in URDFs, and in half as many MJCF files and TOML files of every kind.
calls   Hostile arguments of Python functions and of commands.
kills   A study killed by SIGKILL, resumed, and compared with one that was not, to the bit; threads and processes.
writes  Files of every kind while they are written: killed, or out of space.
settings
        A study begun under one setting of JAX, XLA or NumPy and resumed under another: every one that there is.
users   Another user of the machine against the compilation cache and a running study; needs the superuser.

Prints the counts as JSON, and every failure as it is found; exit code 1 where there was one.
"""

import argparse
import collections
import json
import sys
import tempfile
import time
from pathlib import Path

from attacks import calls, damage, flips, headers, kills, settings, structure, texts, users, writes
from attacks.outcomes import FAILURES

# With the usual number of attempts. Writes are first: they fork, which JAX does not survive once it has computed.
ATTACKS = {
    "writes": (writes.attack, 300),
    "users": (users.attack, 0),
    "kills": (kills.attack, 40),
    "settings": (settings.attack, 200),
    "damage": (damage.attack, 60_000),
    "flips": (flips.attack, 10_000),
    "texts": (texts.attack, 10_000),
    "headers": (headers.attack, 500),
    "structure": (structure.attack, 500),
    "calls": (calls.attack, 400),
}


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--seed", type=int, default=1)
    options.add_argument("--only", nargs="*", choices=ATTACKS, default=list(ATTACKS), help="default: all")
    options.add_argument("--count", type=int, help="attempts in each attack; default: as many as for acceptance")
    given = options.parse_args()
    found: dict[str, dict] = {}
    for name in (name for name in ATTACKS if name in given.only):
        attack, usual = ATTACKS[name]
        started, counts = time.process_time(), collections.defaultdict(collections.Counter)
        with tempfile.TemporaryDirectory() as folder:
            for target, outcome, detail in attack(Path(folder), given.seed, given.count or usual):
                counts[target][outcome] += 1
                if outcome in FAILURES:
                    print(f"{name}: {target}: {outcome}: {detail[:600]}", file=sys.stderr, flush=True)
        total = sum(counts.values(), collections.Counter())
        found[name] = {"total": total, **counts, "cpu_seconds": round(time.process_time() - started)}
        print(f"{name}: {dict(total)}", file=sys.stderr, flush=True)
    print(json.dumps({"seed": given.seed, **found}, indent=2))
    sys.exit(any(found[name]["total"][failure] for name in found for failure in FAILURES))


if __name__ == "__main__":
    main()
