"""The sections of docs/results.md on fields, on the paper's two theorems and on the motion."""

from result_tables import kept_file, measured, note


def fits() -> list[str]:
    """Give the fields that ship, certified, with the grid of exact distances beside each."""
    columns = {
        "target": "target",
        "field": "field",
        "megabytes": "MB",
        "error_bound_point_m": "e_h m, R = 0",
        "found_point_m": "found",
        "error_bound_half_metre_m": "e_h m, R = 0.5 m",
        "found_half_metre_m": "found, R = 0.5 m",
        "p95_point_m": "p95 m, R = 0",
        "p95_half_metre_m": "p95 m, R = 0.5 m",
        "hessian_p99_at_0.3_m": "‖∇²f̃‖ p99 at 0.3 m",
    }
    words = [
        "`python benchmarks/fits.py intelsat30 iss --fields out/fits --json benchmarks/results/fits.json`, "
        "with the shipped fields in `out/fits`; discussed in [The shape](certificate.md). e_h is certified. Found: the "
        "largest value that search and proof met. p95: of the distance from the certified level to the true contact "
        "surface. The grid has the spacing of the network's p95.",
    ]
    return measured("Fields, fitted and certified", words, kept_file("fits"), columns)


def fits_by_seed() -> list[str]:
    """Give fits from several seeds: how good each is, and where its time goes."""
    columns = {
        "target": "target",
        "profile": "profile",
        "seed": "seed",
        "device": "on",
        "error_bound_half_metre_m": "e_h m, R = 0.5 m",
        "margin_mean_m": "margin m, mean",
        "margin_p95_m": "95 %",
        "mean_error_near_m": "error near m",
        "solid_s": "solid s",
        "labels_s": "labels s",
        "steps_s": "steps s",
        "hunts_s": "hunts s",
        "certify_s": "proof s",
        "all_s": "all s",
        "fit_over_sgemm": "fit over its products",
    }
    words = [
        "`python benchmarks/fits.py TARGET --seeds 3 [--profile quick]`, on a GPU the same; turned wings: `--second`. "
        "Margin: e_h − (f̃ − d) over {d = R}, which a flight loses. The first fit of a profile and size compiles. The "
        "last column is the time over that of the matrix products alone, at the rate measured in the same run.",
        *note("fit_seeds"),
    ]
    return measured("Fits by seed", words, kept_file("fit_seeds"), columns)


def slopes() -> list[str]:
    """Give how tight the bounds of a network's slope over cubes are."""
    columns = {
        "stand_off_m": "from the surface m",
        "largest_slope": "largest ‖∇f̃‖ at the centres",
        "side_m": "side m",
        "median": "bound, median",
        "p99": "99 %",
        "largest": "largest",
    }
    words = [
        "`python benchmarks/slopes.py intelsat30 --table --out benchmarks/results/slopes.json`; discussed in [The "
        "shape](certificate.md). Bounds of the slope over cubes at random places, by the side of the cube.",
    ]
    rows = [row for row in kept_file("slopes") if row["side_m"] in (0.02, 0.05, 0.1, 0.2)]
    return measured("Bounds of the slope of intelsat30's network over cubes", words, rows, columns)


def guard_fields() -> list[str]:
    """Give what is proved of the guard's fields, and what a search finds."""
    columns = {
        "target": "target",
        "spacing_m": "spacing m",
        "gradient_bound": "L",
        "largest_slope_found": "largest slope found",
        "error_bound_m": "e_h m",
        "threshold_m": "θ m",
        "evaluation_error_m": "j m",
        "largest_jump_found_m": "largest jump found m",
        "allowance_m": "allowance m",
    }
    words = [
        "`python benchmarks/guard_field.py --out benchmarks/results/guard_field.json`; discussed in "
        "[The shape](certificate.md). For a chaser of 0.5 m; searches start from 1,000,000 points in and beyond the "
        "domain. A jump is at most 2 j.",
    ]
    return measured("The guard's field", words, kept_file("guard_field"), columns)


def theorems() -> list[str]:
    """Give in how many states the paper's two theorems hold over one period."""
    columns = {
        "law": "law",
        "case": "case",
        "states": "states",
        "barrier_condition_fails": "h₁ condition fails in",
        "worst_barrier_margin_m": "worst h₁(T) − e^(−β_c T) h₁(0), m",
        "leaves_safe_set": "leaves {h₁ ≥ 0} in",
        "least_h1_m": "least h₁(T), m",
        "lyapunov_grows": "V₁ grows in",
        "worst_lyapunov_growth": "largest V₁(T)/V₁(0) − 1",
    }
    words = [
        "`python benchmarks/theorems.py --out benchmarks/results/theorems.json`; discussed in [The "
        "law](control.md#the-papers-two-theorems-and-what-is-flown). Random states inside {h₁ ≥ 0} around a sphere, "
        "one period each, the disturbance known; shares of the states. With the default gains sampling alone costs "
        "nothing: what fails, fails by the thrust, in states that turn towards the surface faster than 0.1 N can stop. "
        "The printed gains turn every correction at 1 Hz into its opposite, which only the saturated thrusters hide.",
        "![Both theorems in continuous time, and at 1 Hz with 0.1 N](figures/theorems-at-1hz.png)",
    ]
    return measured("The two theorems over one period", words, kept_file("theorems"), columns)


def motion() -> list[str]:
    """Give the error of one integration step a second."""
    columns = {"target": "target", "error_1_substep_m": "1 substep, m", "error_4_substeps_m": "4 substeps, m"}
    words = [
        "`python benchmarks/motion.py --out benchmarks/results/motion.json`; discussed in [Motion and "
        "navigation](motion.md). Against steps 32 times finer.",
    ]
    return measured("Error of the motion after 3000 s, one step a second", words, kept_file("motion"), columns)
