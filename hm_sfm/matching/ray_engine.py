"""Stage 3 on many processors or machines: the pairs are matched by workers of a Ray cluster.

Each worker is a process with its own network and features, on one processor core, or on one GPU where the matcher runs
on CUDA. It reads the photos itself, so all machines need them at the same path. The matches are those of match_pairs
with one thread, byte for byte, on processors of the same kind. More threads add up in another order: at least 98 of 100
matches then stay within 0.1 px. Half precision is used where the processor has it.
"""

import os
import time
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

from tqdm import tqdm

from hm_sfm.errors import HmSfmError, WorkerLostError
from hm_sfm.io.batches import store_in_batches
from hm_sfm.matching.matcher import HomoMatcher
from hm_sfm.matching.order import order_pairs
from hm_sfm.matching.run import FeatureCache, MatchingTimes
from hm_sfm.matching.shards import CACHED_IMAGES
from hm_sfm.matching.store import MatchStore
from hm_sfm.types import ImagePair, ImageRef, PairMatches

CHUNK_PAIRS = 16
"""Pairs that a worker takes at a time: what is matched again when it is lost."""
MAX_LOSSES = 3
"""Workers that may be lost over the same pairs, or on their start."""

Chunk = tuple[ImagePair, ...]


class PairWorker:
    """Matches pairs in a process of its own."""

    def __init__(self, shared: list[Any]) -> None:
        """shared: a reference to (images, matcher); in a list, which Ray hands over as it is."""
        self.shared = shared

    def start(self) -> None:
        """Fetch the network: apart from __init__, whose errors Ray doesn't tell from a lost process."""
        import ray

        images, matcher = ray.get(self.shared[0])
        self.cache = FeatureCache(images, matcher, matcher.config.feature_cache_mb, tqdm(disable=True))

    def match(self, chunk: Chunk) -> tuple[list[PairMatches], float]:
        """The matches of the pairs, and the seconds that reading and encoding photos took."""
        before = self.cache.seconds
        return [self.cache.match(pair) for pair in chunk], self.cache.seconds - before


def match_on_cluster(
    images: Sequence[ImageRef], pairs: Sequence[ImagePair], matcher: HomoMatcher, store: MatchStore, quiet: bool = False
) -> MatchingTimes:
    """As match_pairs, on the cluster that Ray is connected to, that RAY_ADDRESS names, or that runs on this machine.

    Where there is none, all cores of this machine are used. Raises what match_pairs raises, and WorkerLostError where
    worker after worker dies over the same pairs.
    """
    import ray

    missing = [pair for pair in pairs if pair not in store]
    started = time.monotonic()
    features = 0.0
    if missing:
        connected_here = not ray.is_initialized()
        if connected_here:
            os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
            ray.init(include_dashboard=False, log_to_driver=False, logging_level="error")
        try:
            images = [replace(image, path=image.path.absolute()) for image in images]
            with tqdm(
                total=len(pairs), initial=len(pairs) - len(missing), desc="matches", unit="pair", disable=quiet
            ) as progress:
                features = spread_pairs(ray, images, missing, matcher, store, progress)
        finally:
            if connected_here:
                ray.shutdown()
    store.merge()
    return MatchingTimes(features=features, match=time.monotonic() - started - features)


@contextmanager
def killing(ray: Any, workers: Sequence[Any]) -> Iterator[None]:
    """Kill the workers in the end, however it comes: those that the list holds then."""
    try:
        yield
    finally:
        for worker in workers:
            ray.kill(worker)


def spread_pairs(
    ray: Any,
    images: Sequence[ImageRef],
    pairs: Sequence[ImagePair],
    matcher: HomoMatcher,
    store: MatchStore,
    progress: tqdm,
) -> float:
    """Match and store the pairs; returns the seconds of encoding, those of all workers divided by their number.

    A worker goes through a run of neighbouring pairs, which share photos, and helps the others when it is done. What a
    lost worker was at is matched by others; another worker takes its place.
    """
    device = "GPU" if matcher.device.type == "cuda" else "CPU"
    count = max(1, int(ray.cluster_resources().get(device, 1)))
    pairs = order_pairs(pairs, CACHED_IMAGES)
    size = max(1, min(CHUNK_PAIRS, len(pairs) // (2 * count)))
    chunks = [pairs[first : first + size] for first in range(0, len(pairs), size)]
    count = min(count, len(chunks))
    queues = [deque(chunks[len(chunks) * k // count : len(chunks) * (k + 1) // count]) for k in range(count)]

    actor_class = ray.remote(num_cpus=1, num_gpus=1 if device == "GPU" else 0, max_restarts=0)(PairWorker)
    shared = [ray.put((images, matcher))]
    workers = [actor_class.remote(shared) for _ in range(count)]
    running: dict[Any, tuple[int, Chunk]] = {worker.start.remote(): (k, ()) for k, worker in enumerate(workers)}
    idle: set[int] = set()
    losses: Counter[Any] = Counter()
    lost = (ray.exceptions.RayActorError, ray.exceptions.ObjectLostError, ray.exceptions.OutOfMemoryError)

    left, encoding = len(chunks), 0.0
    with store_in_batches(store.write) as keep, killing(ray, workers):
        while left:
            (done,), _ = ray.wait(list(running), num_returns=1)
            k, chunk = running.pop(done)
            try:
                result = ray.get(done)
            except lost as error:
                losses[chunk or k] += 1
                if losses[chunk or k] > MAX_LOSSES:
                    where = f"matching {chunk[0].name0} and {chunk[0].name1}" if chunk else "starting"
                    raise WorkerLostError(
                        f"{losses[chunk or k]} workers of the Ray cluster died one after the other while {where}: "
                        "see Ray's logs; is there memory enough?"
                    ) from error
                if chunk:
                    queues[k].appendleft(chunk)
                ray.kill(workers[k])
                workers[k] = actor_class.remote(shared)
                running[workers[k].start.remote()] = (k, ())
            except ray.exceptions.RayTaskError as error:
                if isinstance(error.cause, HmSfmError):
                    raise error.cause from None
                raise
            else:
                idle.add(k)
                if chunk:
                    matches, seconds = result
                    keep(matches)
                    encoding += seconds
                    left -= 1
                    progress.update(len(chunk))
            for k in sorted(idle):
                queue = queues[k] or max(queues, key=len)
                if queue:
                    chunk = queue.popleft() if queue is queues[k] else queue.pop()
                    running[workers[k].match.remote(chunk)] = (k, chunk)
                    idle.discard(k)
    return encoding / count
