"""Stage 3 on many processors or machines: the pairs are matched by workers of a Ray cluster.

Each worker is a process with its own network and features, on one processor core, or on one GPU where the matcher runs
on CUDA. It reads the photos itself, so all machines need them at the same path. The matches are those of match_pairs
with one thread, byte for byte, on processors of one kind. More threads add up in another order, and processors with and
without half precision round otherwise: at least 98 of 100 matches are then found again within 0.1 px.
"""

import logging
import os
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from tqdm import tqdm

from hm_sfm.errors import HmSfmError, WorkerLostError
from hm_sfm.io.batches import store_in_batches
from hm_sfm.matching.feature_cache import FeatureCache, cache_features, match_pair
from hm_sfm.matching.interfaces import MatchingTimes, PairMatcher
from hm_sfm.matching.order import order_pairs
from hm_sfm.matching.shards import CACHED_IMAGES
from hm_sfm.matching.store import MatchStore
from hm_sfm.types import ImagePair, ImageRef, PairMatches

CHUNK_PAIRS = 16
"""Pairs that a worker takes at a time: what is matched again when it is lost."""
MAX_LOSSES = 3
"""Workers that may be lost over the same pairs."""
MAX_RESTARTS = 100
"""Of one worker in a run: on machines that come and go, many are no failure."""

Chunk = tuple[ImagePair, ...]


class PairWorker:
    """Matches pairs in a process of its own."""

    def __init__(self, shared: list[Any]) -> None:
        """shared: a reference to (images, matcher); in a list, which Ray hands over as it is."""
        self.shared = shared
        self.cache: FeatureCache[str] | None = None
        """Made with the first pairs, not here, where Ray does not tell errors from a lost process."""

    def match(self, chunk: Chunk) -> tuple[list[PairMatches], float]:
        """The matches of the pairs, and the seconds that reading and encoding photos took."""
        if self.cache is None:
            import ray

            self.cache = cache_features(*ray.get(self.shared[0]))
        cache, before = self.cache, self.cache.seconds
        return [match_pair(cache, pair) for pair in chunk], cache.seconds - before


def match_on_cluster(
    images: Sequence[ImageRef], pairs: Sequence[ImagePair], matcher: PairMatcher, store: MatchStore, quiet: bool = False
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
            ray.init(include_dashboard=False, log_to_driver=False, logging_level=logging.ERROR)
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


def spread_pairs(
    ray: Any,
    images: Sequence[ImageRef],
    pairs: Sequence[ImagePair],
    matcher: PairMatcher,
    store: MatchStore,
    progress: tqdm,
) -> float:
    """Match and store the pairs; returns the seconds of encoding, those of all workers divided by their number.

    A worker goes through a run of neighbouring pairs, which share photos, and helps the others when it is done. Ray
    starts a lost worker again, on any machine with room, and with it the pairs that it was at.
    """
    device = "GPU" if matcher.device.type == "cuda" else "CPU"
    count = max(1, int(ray.cluster_resources().get(device, 1)))
    ordered = order_pairs(pairs, CACHED_IMAGES)
    size = max(1, min(CHUNK_PAIRS, len(ordered) // (2 * count)))
    chunks = [ordered[first : first + size] for first in range(0, len(ordered), size)]
    count = min(count, len(chunks))
    queues = [deque(chunks[len(chunks) * k // count : len(chunks) * (k + 1) // count]) for k in range(count)]

    options = {"num_cpus": 1, "num_gpus": int(device == "GPU")}
    restarts = {"max_restarts": MAX_RESTARTS, "max_task_retries": MAX_LOSSES}
    shared = [ray.put((images, matcher))]
    workers = [ray.remote(**options, **restarts)(PairWorker).remote(shared) for _ in range(count)]
    running: dict[Any, tuple[int, Chunk]] = {}

    def send_chunk(k: int) -> None:
        """Give a worker its next pairs, or the last ones of who has most left; without any it makes room."""
        queue = queues[k] or max(queues, key=len)
        if not queue:
            ray.kill(workers[k])
            return
        chunk = queue.popleft() if queue is queues[k] else queue.pop()
        running[workers[k].match.remote(chunk)] = (k, chunk)

    encoding = 0.0
    try:
        with store_in_batches(store.write) as keep:
            for k in range(count):
                send_chunk(k)
            while running:
                (done,), _ = ray.wait(list(running), num_returns=1)
                k, chunk = running.pop(done)
                matches, seconds = fetch(ray, done, chunk)
                keep(matches)
                encoding += seconds
                progress.update(len(chunk))
                send_chunk(k)
    finally:
        for worker in workers:
            ray.kill(worker)
    return encoding / count


def fetch(ray: Any, done: Any, chunk: Chunk) -> tuple[list[PairMatches], float]:
    """What PairWorker.match returned for a chunk. Raises what it raised, and WorkerLostError where it was given up."""
    try:
        return ray.get(done)
    except (ray.exceptions.RayActorError, ray.exceptions.ObjectLostError, ray.exceptions.OutOfMemoryError) as error:
        raise WorkerLostError(
            f"{MAX_LOSSES + 1} workers of the Ray cluster died one after the other while matching {chunk[0].name0} and "
            f"{chunk[0].name1}: see Ray's logs; is there memory enough?"
        ) from error
    except ray.exceptions.RayTaskError as error:
        if isinstance(error.cause, HmSfmError):
            raise error.cause from None
        raise
