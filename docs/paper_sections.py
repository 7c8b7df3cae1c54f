"""The sections of docs/results.md on the paper: its Section VI, its training and its errata."""

from result_tables import kept_file, measured, note, table

from keepout.apps.reproduction.fitted import PAPER_NETWORK
from keepout.apps.reproduction.table1 import PRINTED_TABLE

ERRATA = {
    "erratum": "erratum",
    "quantity": "quantity",
    "printed": "as printed",
    "mended": "mended",
    "unit": "unit",
}
TRAINING = {
    "target": "target",
    "width": "width",
    "depth": "layers",
    "steps": "steps",
    "batch": "batch",
    "start": "start",
    "device": "on",
    "products": "products",
    "distance_term": "L_P",
    "gradient_term": "L_E",
    "mean_error_radii": "mean of f̃ − d",
    "surface_error_radii": "ε",
    "surface_overstatement_radii": "ε₊",
    "worst_overstatement_radii": "e_h sampled",
    "over_printed": "over printed: ε, ε₊, e_h",
    "fit_s": "fit s",
}


def reproduction() -> list[str]:
    """Give the paper's Section VI, part by part."""
    kept = kept_file("paper")
    lines = [
        "## The paper's Section VI, repeated",
        "",
        "`keepout reproduce all --fields benchmarks/results/fields -o out/paper` writes this as `tables.json`. "
        "Reached: the flight ends within the goal's tolerance, 0.1 m. "
        "The time to reach is that since which the flight stays there; it may have been "
        "there before and have left again. In Case 3 flights last 3000 s around intelsat30 and 4000 s around iss, and "
        "with a larger k_p 6 (k_p − 1.5 m)/v_max longer. Compare Δv only between rows of one duration.",
        "",
        *note("paper"),
        "",
        "**How long parts took on 2 cores beside other work, with the networks of `benchmarks/results/fields`**",
        "",
        *table(
            [{"part": one["name"], "minutes": one["seconds"] / 60.0} for one in kept["sections"] if "seconds" in one]
        ),
    ]
    for section in kept["sections"]:
        lines += [f"### {section['title']}", "", f"The paper: {section['paper']}", ""]
        for paragraph in section["ours"]:
            lines += [paragraph, ""]
        for entry in section["tables"]:
            lines += [f"**{entry['caption']}**", "", *table(entry["rows"])]
    return lines


def training() -> list[str]:
    """Give fits by the paper's loss, by target, network, batch and start."""
    words = [
        "`python benchmarks/training.py`, on a GPU with `--width 512 --depth 10 --steps 5000 --products tf32`; see "
        "[Reproduce the paper](reproduce.md). The paper's network has 10 layers of 512, its set 50,000 points; the "
        "smaller network has its loss, rate and number of halvings. Terms of the loss are means over the last tenth of "
        "the steps. ε, ε₊ and e_h are those of Table I. Lengths are in units of the ball that is learned; the last "
        "ratios are to what is printed, read in that unit. With all 50,000 points a step, not 2048, errors come near "
        "or below those printed.",
        *note("training"),
    ]
    rows = []
    for row in kept_file("training"):
        found = [row.get(name) for name in list(TRAINING)[-5:-2]]
        paper = None not in found and row["width"] == PAPER_NETWORK.profile.width
        ratios = [f"{of / printed:.2f}" for of, printed in zip(found, PRINTED_TABLE[row["target"]])] if paper else []
        rows.append(dict.fromkeys(TRAINING) | row | {"over_printed": ", ".join(ratios) or None})
    return measured("Batch and start of the paper's training", words, rows, TRAINING)


def errata() -> list[str]:
    """Give what each slip of the paper does."""
    words = ["`python benchmarks/errata.py`; discussed in [The control law](control.md#the-papers-equations-1-to-48)."]
    return measured("The paper's errata, measured", words, kept_file("errata"), ERRATA)
