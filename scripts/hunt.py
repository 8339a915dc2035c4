"""Hunt for faults: random legal plants over all that is accepted, held against independent answers.

    python scripts/hunt.py                               every check, about five minutes in all
    python scripts/hunt.py --minutes 60 --seed 7         longer, other plants
    python scripts/hunt.py --only steps --plants 2000000
    python scripts/hunt.py --replay steps-0-1234         one trial again, as a failure names it

Prints for each check how many trials were tried, held, set aside (and why) and failed; exit status 1 if any failed.
Ctrl-C ends the check that runs, prints what was found until then, and stops.
"""

import argparse
import sys
import time
from collections import Counter

from scripts.hunting import against_scipy, environments, events, fuzz, motions, slow, steps
from scripts.hunting.trials import Check, Failure, Findings, Interrupted, SetAside, hunt

CHECKS = {
    check.name: check
    for check in (
        steps.CHECK,
        slow.CHECK,
        against_scipy.CHECK,
        events.CHECK,
        environments.BATCHES,
        environments.INTERPRETED_CHECK,
        environments.INFOS,
        motions.ATTRACTORS,
        motions.MULTIPLIERS,
        motions.LABELS,
        motions.FILES,
        fuzz.LEGAL,
        fuzz.ARGUMENTS,
        fuzz.COMMANDS,
    )
}
_SHOWN = 5  # failures of each kind
_MOST_SLOW = 20  # trials that had to be ended, before a check is left


def main(arguments: list[str] | None = None) -> int:
    """Run the command; return its exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0, help="of all that is drawn (default: 0)")
    parser.add_argument("--minutes", type=float, default=5.0, help="for all checks together (default: 5)")
    parser.add_argument("--plants", type=int, metavar="N", help="so many trials of each check, however long they take")
    parser.add_argument("--first", type=int, default=0, metavar="INDEX", help="of the trials (default: 0)")
    parser.add_argument("--only", nargs="+", choices=CHECKS, metavar="CHECK", help=f"of {', '.join(CHECKS)}")
    parser.add_argument("--replay", metavar="CHECK-SEED-INDEX", help="run one trial here, and let its error through")
    chosen = parser.parse_args(arguments)
    if chosen.replay:
        return replay(chosen.replay)
    checks = [CHECKS[name] for name in chosen.only or CHECKS]
    shares = sum(check.share for check in checks)
    failed = 0
    for check in checks:
        seconds = None if chosen.plants else 60.0 * chosen.minutes * check.share / shares
        begun = time.monotonic()
        show = Progress(check)
        try:
            findings = hunt(check, chosen.seed, chosen.first, chosen.plants, seconds, _MOST_SLOW, show)
        except Interrupted as stop:
            tell(check, chosen.seed, stop.findings, time.monotonic() - begun)
            return 1
        tell(check, chosen.seed, findings, time.monotonic() - begun)
        failed += len(findings.failures)
    print(f"\n{failed} failed" if failed else "\nall held")
    return 1 if failed else 0


class Progress:
    """Shows on a terminal how far a check is."""

    def __init__(self, check: Check) -> None:
        self._name = check.name
        self._next = 0.0

    def __call__(self, findings: Findings) -> None:
        if sys.stderr.isatty() and time.monotonic() > self._next:
            self._next = time.monotonic() + 1.0
            print(f"\r{self._name}: {findings.tried} tried, {len(findings.failures)} failed", end="\r", file=sys.stderr)


def tell(check: Check, seed: int, findings: Findings, seconds: float) -> None:
    """Print what became of a check."""
    failures = findings.failures
    print(f"\n{check.name}: {check.title}")
    print(f"  tried {findings.tried}, held {findings.held}, failed {len(failures)} ({seconds:.0f} s)")
    for reason, count in findings.aside.most_common():
        print(f"  set aside: {count} ({reason})")
    for name, (value, index) in findings.greatest.items():
        print(f"  {name}: {value:.3g} ({check.name}-{seed}-{index})")
    for kind, count in Counter(map(kind_of, failures.values())).most_common():
        print(f"  failed: {count} ({kind})")
        for index, words in [entry for entry in sorted(failures.items()) if kind_of(entry[1]) == kind][:_SHOWN]:
            print(f"    FAILED {check.name}-{seed}-{index}: {words}")
        if count > _SHOWN:
            print(f"    and {count - _SHOWN} more")
    sys.stdout.flush()


def kind_of(words: str) -> str:
    """Return the kind of a failure, the part of its words in brackets."""
    return words[1 : words.index("]")]


def replay(name: str) -> int:
    """Run one trial in this process; return the exit status."""
    check, seed, index = ["", "", "", *name.rsplit("-", 2)][-3:]
    if check not in CHECKS or not (seed.isdigit() and index.isdigit()):
        print(f"--replay must be CHECK-SEED-INDEX with a check of {', '.join(CHECKS)}, got {name!r}", file=sys.stderr)
        return 2
    chosen = CHECKS[check]
    if chosen.drawn is not None:
        print(chosen.drawn(int(seed), int(index)), flush=True)
    chosen.prepare()
    try:
        numbers = chosen.trial(int(seed), int(index))
    except SetAside as reason:
        print(f"set aside: {reason}")
    except Failure as found:
        print("\n".join([f"FAILED: {found}", *getattr(found, "__notes__", [])]))
        return 1
    else:
        print(f"held {dict(numbers or {})}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
