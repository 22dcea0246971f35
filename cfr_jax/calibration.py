"""What the confidences were fitted to: coefficients of two logistic regressions.

Written by `benchmarks/fit_confidence.py`; not to be edited. Fitted with the weights `object`.
"""

REGISTER = {
    "bias": -19.6468,
    "source_found": -0.6182,
    "target_found": -0.6182,
    "settled": -0.3191,
    "settling": 0.1317,
    "residual": -8.1124,
    "sharpness": -8.3798,
    "lever": 2.4753,
}

ALIGN = {
    "bias": 4.8932,
    "source_found": -1.1882,
    "target_found": -1.1882,
    "settled": -0.4659,
    "settling": -0.0783,
    "residual": -2.3215,
    "sharpness": 3.7177,
    "lever": 1.3993,
    "fitness": 1.4600,
    "distance": -19.4818,
    "agreement": 0.2090,
    "resistance": 11.2519,
}
