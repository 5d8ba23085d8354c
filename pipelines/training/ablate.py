"""The paper's three ablations: what supervises the fine stage, its w/r/K, and the coarse transformer.

    python pipelines/training/ablate.py configs/train_ablations.yaml --scene SCENE --attention-weights FILE

Each version of the fine stage starts from the same features with a new head and trains for the same few steps. FILE
holds a network with a trained coarse transformer: it is scored with the transformer, and without it by mutual nearest
neighbours of the plain features, both at one precision; without FILE there is no third table. SCENE has the layout of
Strecha's data sets: images/, gt_dense_cameras/ and K.txt.

Each version has a folder of its own below the configuration's `out`: an interrupted run goes on from there and repeats
nothing. After a change of code, photos, scene or weights, take a new `out`.
"""

import argparse
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from ablation_scores import (
    CELLS,
    POINTS,
    Scores,
    Trial,
    describe_trial,
    drop_head,
    drop_transformer,
    equalise_precision,
    prepare_trial,
    score_matches,
    score_net,
    score_once,
)  # fmt: skip

from hm_sfm.config import load_config
from hm_sfm.errors import ConfigError, HmSfmError
from hm_sfm.io.atomic import replace_file
from hm_sfm.network.checkpoints import digest_weights, load_weights
from hm_sfm.training.config import TrainConfig
from hm_sfm.training.loop import train

SUPERVISIONS = {"semi-dense": "centre", "+ dense": "dense", "+ suppressed": "suppressed"}
"""Row -> TrainConfig.supervise."""
SIZES = ((5, 1, 1, 1), (9, 1, 1, 1), (9, 1, 3, 1), (9, 3, 1, 1), (9, 3, 3, 1), (9, 1, 3, 2))
"""w, r, K and network.spacing, 1 in the paper."""


def ablate(config: TrainConfig, scene: Path, attention_weights: Path | None) -> str:
    """The tables, as Markdown. Raises HmSfmError on unusable photos, scene or weights."""
    trial = prepare_trial(config, scene)
    coarse = score_coarse(attention_weights, trial) if attention_weights else {}
    config = replace(config, start_from=str(drop_head(Path(config.start_from), Path(config.out) / "features.pt")))
    losses = {row: score_version(replace(config, supervise=name), trial) for row, name in SUPERVISIONS.items()}
    # LoFTR's head, trained as LoFTR does: a point has no homography to supervise.
    expectation = replace(config, network=replace(config.network, head="expectation"), supervise="centre")
    sizes = {"expectation": score_version(expectation, trial)}
    for w, r, k, spacing in SIZES:
        network = replace(config.network, window=w, radius=r, iterations=k, spacing=spacing)
        sizes[f"{w}/{r}/{k}" + f", spacing {spacing}" * (spacing > 1)] = score_version(
            replace(config, network=network), trial
        )
    tables = {
        "What supervises the fine stage": format_markdown(losses, POINTS),
        "The size of the fine stage: w/r/K": format_markdown(sizes, (*POINTS, "fine ms")),
        "The coarse transformer": format_markdown(coarse, (*CELLS, *POINTS, "coarse ms")) if coarse else "",
    }
    return "".join(f"\n## {title}\n\n{table}\n" for title, table in tables.items() if table)


def score_version(config: TrainConfig, trial: Trial) -> Scores:
    """Train a version of the fine stage, or finish an interrupted training, and score it."""
    net = config.network
    size = "-".join(map(str, (net.window, net.radius, net.iterations, net.spacing)))
    config = replace(config, out=str(Path(config.out) / f"{net.head}-{size}-{config.supervise}"))
    print(config.out, file=sys.stderr)
    stored = Path(config.out) / f"scores-{trial.key}.json"
    # The features are matched by their cosines, which have a threshold of their own.
    return score_once(
        stored, lambda: score_matches(load_weights(str(train(config, resume=True))), trial, config.coarse_threshold)
    )


def score_coarse(weights: Path, trial: Trial) -> dict[str, Scores]:
    """A network with its coarse transformer and without it, at the same precision; ConfigError where it has none."""
    net = load_weights(str(weights))
    if net.config.coarse != "attention":
        raise ConfigError(f"{weights} has no coarse transformer: network.coarse is {net.config.coarse!r}")
    folder = Path(trial.config.out) / f"coarse-{digest_weights(str(weights))[:8]}"
    plain = drop_transformer(net)

    def score_with_transformer() -> Scores:
        return score_net(net, trial, equalise_precision(net, trial, without["precision"]))

    without = score_once(
        folder / f"without-{trial.key}.json", lambda: score_net(plain, trial, trial.config.coarse_threshold)
    )
    return {"with": score_once(folder / f"with-{trial.key}.json", score_with_transformer), "without": without}


def format_markdown(rows: Mapping[str, Mapping[str, float]], columns: Sequence[str]) -> str:
    """Scores by row and column as a table of Markdown, with one digit; columns that no row has are left out."""
    known = [name for name in columns if any(name in scores for scores in rows.values())]
    cells = [["", *known], *([row, *(f"{scores[name]:.1f}" for name in known)] for row, scores in rows.items())]
    widths = [max(3, *map(len, column)) for column in zip(*cells)]
    cells.insert(1, ["-" * widths[0], *("-" * (width - 1) + ":" for width in widths[1:])])
    lines = ([line[0].ljust(widths[0]), *map(str.rjust, line[1:], widths[1:])] for line in cells)
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("config", metavar="CONFIG", type=Path, help="what all trainings have in common")
    parser.add_argument("--scene", type=Path, required=True, help="photos with known cameras")
    parser.add_argument("--attention-weights", type=Path, metavar="FILE", help="adds the third table")
    parser.add_argument("--steps", type=int, help="of each training (default: those of CONFIG)")
    parser.add_argument("--report", type=Path, metavar="FILE", default=Path("docs/ablations.md"))
    options = parser.parse_args()
    try:
        settings = () if options.steps is None else (f"steps={options.steps}",)
        config = load_config(options.config, settings, TrainConfig)
        tables = ablate(config, options.scene, options.attention_weights)
    except HmSfmError as error:
        parser.exit(error.exit_code, f"{parser.prog}: {error}\n")
    print(tables)
    options.report.parent.mkdir(parents=True, exist_ok=True)
    with replace_file(options.report) as temporary:
        temporary.write_text(describe_trial(config, options.scene, shlex.join(["python", *sys.argv])) + tables)


if __name__ == "__main__":
    main()
