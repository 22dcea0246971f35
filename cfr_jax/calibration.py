"""What the confidences were fitted to: coefficients of two logistic regressions.

Written by `benchmarks/fit_confidence.py`; not to be edited. Fitted with the weights `object`.
"""

REGISTER = {
    "bias": -18.2507,
    "source_found": -1.1292,
    "target_found": -1.1292,
    "settled": -0.0735,
    "settling": -0.0527,
    "residual": -8.0293,
    "sharpness": -8.1287,
    "lever": 2.8908,
}

ALIGN = {
    "bias": 2.6786,
    "source_found": 0.1904,
    "target_found": 0.1904,
    "settled": 0.2997,
    "settling": -0.6192,
    "residual": -3.2328,
    "sharpness": 2.6092,
    "lever": 1.9926,
    "fitness": -0.5628,
    "distance": -18.3966,
    "agreement": 0.4064,
    "resistance": 11.4294,
}
