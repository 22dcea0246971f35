"""What the confidences were fitted to: coefficients of two logistic regressions.

Written by `benchmarks/fit_confidence.py`; not to be edited. Fitted with the weights `object`.
"""

REGISTER = {
    "bias": -14.3305,
    "source_found": 0.4273,
    "target_found": 0.4273,
    "settled": -0.9261,
    "settling": 0.3409,
    "residual": -6.4716,
    "sharpness": 3.0366,
    "lever": 2.6554,
}

ALIGN = {
    "bias": 1.8872,
    "source_found": -0.7862,
    "target_found": -0.7862,
    "settled": 0.1353,
    "settling": -0.4322,
    "residual": -4.6802,
    "sharpness": 8.5504,
    "lever": 1.9813,
    "fitness": -2.1477,
    "distance": -19.6648,
    "agreement": 0.0974,
    "resistance": 9.2977,
}
