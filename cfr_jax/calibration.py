"""What the confidences were fitted to: coefficients of two logistic regressions.

Written by `benchmarks/fit_confidence.py`; not to be edited. Fitted with the weights `object`.
"""

REGISTER = {
    "bias": -18.0104,
    "source_found": -1.2689,
    "target_found": -1.2689,
    "settled": -0.6711,
    "settling": 0.1424,
    "residual": -7.5961,
    "sharpness": -5.1568,
    "lever": 2.0202,
}

ALIGN = {
    "bias": 6.3217,
    "source_found": -2.1648,
    "target_found": -2.1648,
    "settled": -0.4430,
    "settling": -0.3114,
    "residual": -2.2815,
    "sharpness": 6.0933,
    "lever": 1.5347,
    "fitness": 1.8786,
    "distance": -19.6943,
    "agreement": 0.1863,
    "resistance": 10.6486,
}
