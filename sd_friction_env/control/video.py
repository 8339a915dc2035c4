"""Videos of episodes, passive and controlled side by side; needs pygame-ce and imageio (extra "video")."""

import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from sd_friction_env.control.policies.policy import Policy, State, ZeroPolicy
from sd_friction_env.environments.single import SDFrictionEnv
from sd_friction_env.extras import extra
from sd_friction_env.storage import checked_ending

FORMATS = (".gif", ".mp4")
MOST_STEPS = 100_000
_GAP = 8  # pixels between the two pictures


def frames(
    env_id: str,
    policy: Policy,
    *,
    seed: int = 0,
    steps: int = 300,
    size: tuple[int, int] = (960, 540),
    every: int = 1,
    side_by_side: bool = True,
    title: str = "controlled",
    env_kwargs: Mapping[str, Any] | None = None,
) -> Iterator[NDArray[np.uint8]]:
    """Yield the frames of an episode, the first before the first step.

    Args:
        env_id: of the environment. policy: its controller.
        seed: of ``reset``. steps: at most; the episode may end before. size: of one picture, in pixels.
        every: control intervals per frame.
        side_by_side: whether to add the passive oscillator with the same start, on the left.
        title: of the controlled oscillator's picture.
        env_kwargs: arguments of the environment.

    Yields:
        Arrays (height, width, 3), uint8.
    """
    policies: dict[str, Policy] = {"passive": ZeroPolicy()} if side_by_side else {}
    policies[title] = policy
    envs = []
    for name in policies:
        env = gym.make(env_id, render_mode="rgb_array", render_size=size, **dict(env_kwargs or {})).unwrapped
        if not isinstance(env, SDFrictionEnv):
            raise TypeError(f"env_id must name an environment of sd_friction_env, got {env_id!r}")
        env.title = name
        envs.append(env)
    observations = [env.reset(seed=seed)[0] for env in envs]
    states: list[State] = [None] * len(envs)
    try:
        yield _beside([env.render() for env in envs])
        for t in range(steps):
            over = False
            for i, (env, chosen) in enumerate(zip(envs, policies.values(), strict=True)):
                action, states[i] = chosen.predict(observations[i][None], states[i], np.array([t == 0]))
                observations[i], _, terminated, truncated, _ = env.step(action[0])
                over |= terminated or truncated
            if (t + 1) % every == 0 or over:
                yield _beside([env.render() for env in envs])
            if over:
                return
    finally:
        for env in envs:
            env.close()


def _beside(pictures: list[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    if len(pictures) == 1:
        return pictures[0]
    gap = np.full((pictures[0].shape[0], _GAP, 3), 255, np.uint8)
    return np.concatenate([pictures[0], gap, *pictures[1:]], axis=1)


def check_video_path(path: str | os.PathLike[str], fps: int = 30) -> Path:
    """Return the path of a video after checking that it can be written.

    Raises:
        ValueError: if its ending is none of ``FORMATS``, its folder does not exist, or ``fps`` exceeds what players
            support: 60 frames a second, 50 for a GIF.
        ImportError: if a package that writes it is not installed.
    """
    target, ending = Path(path), checked_ending(path, FORMATS, "the video's name")
    if target.is_dir() or not target.parent.is_dir():
        raise ValueError(f"the video must be a file in a folder that exists, got {os.fspath(path)!r}")
    fastest, kind = (50, " for a GIF") if ending == ".gif" else (60, "")
    if not 1 <= fps <= fastest:
        raise ValueError(f"fps must be in [1, {fastest}]{kind}, got {fps!r}")
    with extra("video"):
        import imageio  # noqa: F401

        if ending == ".mp4":
            import imageio_ffmpeg  # noqa: F401
    return target


def write_video(
    path: str | os.PathLike[str],
    pictures: Iterator[NDArray[np.uint8]],
    *,
    fps: int = 30,
    progress: Callable[[int], None] = lambda done: None,
) -> Path:
    """Write frames to an .mp4 (H.264) or .gif file atomically; return the path.

    Args:
        path: of the file. pictures: frames of one size. fps: frames a second.
        progress: called with the number of frames written.

    Raises:
        ValueError, ImportError: as :func:`check_video_path`. OSError: if it cannot be written.
    """
    target = check_video_path(path, fps)
    import imageio.v2 as imageio

    ending = target.suffix.lower()  # imageio knows lower case only
    unfinished = target.with_name(f".{target.stem}.{os.getpid()}{ending}")
    # Few colours keep a GIF small, and the pictures need no more.
    options: dict[str, Any] = (
        {"duration": 1000.0 / fps, "loop": 0, "subrectangles": True, "palettesize": 32}
        if ending == ".gif"
        else {"fps": fps, "macro_block_size": 2, "codec": "libx264", "quality": 7, "ffmpeg_log_level": "error"}
    )
    try:
        unfinished.touch()  # a clear error before imageio opens anything
    except OSError as error:
        raise OSError(f"{os.fspath(path)!r}: {error.strerror}") from None
    try:
        writer: Any = imageio.get_writer(unfinished, **options)
        with writer:
            for done, picture in enumerate(pictures, start=1):
                writer.append_data(picture)
                progress(done)
        os.replace(unfinished, target)
    finally:
        unfinished.unlink(missing_ok=True)
    return target
