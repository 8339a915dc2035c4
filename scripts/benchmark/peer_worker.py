"""Step a peer in this interpreter: answers "N\\n" on stdin with the rate of a slice of N calls.

The answers have a pipe of their own: what libraries print does not get into them.
"""

# mypy: disable-error-code="no-untyped-call, no-untyped-def, import-not-found"

import json
import os
import sys
import time

answers = os.fdopen(os.dup(1), "w", buffering=1)
os.dup2(2, 1)
program, n, threads = json.loads(sys.argv[1])
try:
    import numpy as np

    rng = np.random.default_rng(0)
    if program == "envpool":
        import envpool

        env = envpool.make("Pendulum-v1", "gymnasium", num_envs=n, num_threads=threads)
        env.reset()
        actions = [rng.uniform(-2.0, 2.0, (n, 1)).astype(np.float32) for _ in range(16)]

        def run(calls):
            for i in range(calls):
                env.step(actions[i % 16])

    else:
        import gymnax
        import jax

        env, parameters = gymnax.make("Pendulum-v1")
        # Random numbers are for resets only: drawn beforehand, they cost nothing here.
        keys = jax.random.split(jax.random.key(0), n)
        actions = [jax.device_put(rng.uniform(-2.0, 2.0, (n,)).astype(np.float32)) for _ in range(16)]
        held = [jax.jit(jax.vmap(env.reset, in_axes=(0, None)))(keys, parameters)[1]]
        every = jax.vmap(env.step, in_axes=(0, 0, 0, None))
        if program == "gymnax":
            step = jax.jit(every)

            def run(calls):
                for i in range(calls):
                    held[0] = jax.block_until_ready(step(keys, held[0], actions[i % 16], parameters))[1]

        else:
            table = jax.numpy.stack(actions)

            def scanned(state, indices):
                def one(state, i):
                    out = every(keys, state, table[i], parameters)
                    return out[1], (out[0], out[2], out[3])

                return jax.lax.scan(one, state, indices)

            scan = jax.jit(scanned)

            def run(calls):
                held[0] = jax.block_until_ready(scan(held[0], jax.numpy.arange(calls) % 16))[0]

    run(2)
except ImportError as error:
    print(json.dumps({"missing": str(error)}), file=answers)
    sys.exit()
print(json.dumps({"missing": ""}), file=answers)
for line in sys.stdin:
    calls = int(line)
    begin = time.perf_counter()
    run(calls)
    print(json.dumps({"rate": calls * n / (time.perf_counter() - begin)}), file=answers)
