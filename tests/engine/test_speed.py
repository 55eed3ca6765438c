"""Speed, as ratios within one run: machines differ and are noisy, ratios much less."""

from benchmarks.speed import Budget, engine_case, interleaved, plain_case
from mbn_marl import BatchEngine

WORLDS = 1024


def test_engine_is_far_faster_than_the_plain_loop():
    """By a hundred times an env-step, on one thread; the benchmark measures by how much."""
    engine = engine_case("engine", BatchEngine("field_01", WORLDS, threads=1), warm_up=50)
    loop = plain_case()
    timings = interleaved([engine, loop], Budget(rounds=15, seconds=0.02)).cpu
    # The best round of each: other work on the machine only ever makes a round slower.
    best = timings.min()
    assert best[loop.name] / best["engine"] > 100
