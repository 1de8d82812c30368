"""How rliable.json was made, once: rliable 1.2.0 does not import beside pandas 3, so it had an environment of its own.

python3 -m venv rliable && rliable/bin/pip install rliable==1.2.0 'arch<8' pandas==2.3.3
rliable/bin/python tests/golden/analysis/make_rliable.py > tests/golden/analysis/rliable.json
"""

import json

import numpy as np
from rliable import library, metrics

SEED = 2020
RUNS, TASKS, RESAMPLES = 5, 4, 20_000
TAUS = [0.0, 0.25, 0.5, 0.75, 1.0]

generator = np.random.default_rng(SEED)
x = generator.normal(0.6, 0.3, (RUNS, TASKS)).round(3)
y = generator.normal(0.5, 0.3, (RUNS, TASKS)).round(3)
y[0, 0] = x[1, 0]  # a tie


def interval(scores, statistic):
    """Stratified percentile bootstrap, [low, high]."""
    _, bounds = library.get_interval_estimates(
        {"x": scores},
        lambda s: np.array([statistic(s)]),
        reps=RESAMPLES,
        random_state=np.random.RandomState(SEED),
    )
    return bounds["x"][:, 0].tolist()


print(
    json.dumps(
        {
            "rliable": "1.2.0",
            "resamples": RESAMPLES,
            "x": x.tolist(),
            "y": y.tolist(),
            "mean": float(metrics.aggregate_mean(x)),
            "iqm": float(metrics.aggregate_iqm(x)),
            "iqm_interval": interval(x, metrics.aggregate_iqm),
            "mean_interval_of_task_0": interval(x[:, :1], metrics.aggregate_mean),
            "probability_of_improvement": float(metrics.probability_of_improvement(x, y)),
            "taus": TAUS,
            "profile": [library.run_score_deviation(x, tau) for tau in TAUS],
        },
        indent=1,
    )
)
