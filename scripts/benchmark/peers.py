"""Batches of EnvPool and gymnax, in an interpreter of their own."""

import contextlib
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import gymnasium as gym

from scripts.benchmark.batches import EPISODE, FORCE, batch_slice, our_label, panel
from scripts.benchmark.measuring import Bench, Contender, Slice

WORKER = Path(__file__).with_name("peer_worker.py")


class PeerError(Exception):
    """A peer cannot run here; the message says why."""


class Peer:
    """A peer's batch in another interpreter, asked for one slice at a time."""

    def __init__(self, python: Path, program: str, n: int, threads: int) -> None:
        self._stderr = tempfile.TemporaryFile("w+")  # noqa: SIM115 - closed by close()
        self._process = subprocess.Popen(
            [str(python), "-W", "ignore", str(WORKER), json.dumps([program, n, threads])],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._stderr,
            text=True,
            cwd=tempfile.gettempdir(),
        )
        try:
            missing = self._answer()["missing"]
            if missing:
                raise PeerError(f"{python} cannot import it ({missing}); `make benchmark-peers` makes .venv-peers")
        except BaseException:
            self.close()
            raise

    def _answer(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            self._stderr.seek(0)
            last = self._stderr.read().strip().splitlines()[-1:] or ["no message"]
            raise PeerError(f"its process ended with: {last[0]}")
        answer: dict[str, Any] = json.loads(line)
        return answer

    def slice(self, calls: int) -> Slice:
        """Return slices of this many calls."""

        def run() -> float:
            assert self._process.stdin is not None
            self._process.stdin.write(f"{calls}\n")
            self._process.stdin.flush()
            return float(self._answer()["rate"])

        return run

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout, self._stderr):
            assert stream is not None
            with contextlib.suppress(BrokenPipeError):
                stream.close()


PEERS = {
    "EnvPool Pendulum-v1, 1,024, 1 thread": ("envpool", 1),
    "EnvPool Pendulum-v1, 1,024, 2 threads": ("envpool", 2),
    "gymnax Pendulum-v1, 1,024, call by call": ("gymnax", 0),
    "gymnax Pendulum-v1, 1,024, all calls compiled into one": ("gymnax scan", 0),
}


def peers(bench: Bench) -> None:
    """A batch of 1,024 against EnvPool and gymnax."""
    n = 1024
    python = bench.peers or Path(sys.executable)
    steps = bench.length(2 * EPISODE, EPISODE)
    contenders = []
    with contextlib.ExitStack() as stack:
        for label, (program, threads) in PEERS.items():
            bench.progress(f"peers: starting {label}", passing=True)
            try:
                peer = Peer(python, program, n, threads)
            except PeerError as error:
                bench.skip(f"peers: {label}", str(error))
                continue
            stack.callback(peer.close)
            contenders.append(Contender(label, peer.slice(steps), panel=panel(n)))
        if not contenders:
            return
        reference = contenders[0].label
        for threads in (1, 2):
            run = batch_slice(gym.make_vec(FORCE, num_envs=n, threads=threads), steps)
            contenders.append(Contender(our_label(FORCE, n, threads), run, True))
        bench.measure("peers", "A batch of 1,024 against EnvPool and gymnax, steps per second", contenders, reference)
