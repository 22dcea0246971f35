"""What the confidences were fitted to: coefficients of two logistic regressions.

Written by `benchmarks/fit_confidence.py`; not to be edited. Fitted with the weights `object`.
"""

REGISTER = {
    "bias": -15.2606,
    "source_found": -0.4098,
    "target_found": -0.4098,
    "settled": -0.8790,
    "settling": 0.2096,
    "residual": -6.6449,
    "sharpness": -1.3693,
    "lever": 2.2272,
}

ALIGN = {
    "bias": 0.1747,
    "source_found": 0.0413,
    "target_found": 0.0413,
    "settled": 0.3690,
    "settling": -0.3697,
    "residual": -4.6369,
    "sharpness": 9.3587,
    "lever": 1.6841,
    "fitness": -2.5069,
    "distance": -18.4206,
    "agreement": -0.0186,
    "resistance": 9.3476,
}
