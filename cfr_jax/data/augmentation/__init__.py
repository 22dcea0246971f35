"""Training pairs from shapes and scans, turned, cropped and made noisy like users' clouds.

`sampling` says how pairs are drawn. The host and the device draw them with the same distributions,
but not with the same random numbers.
"""
