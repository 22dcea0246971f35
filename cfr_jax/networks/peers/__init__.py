"""DCP, FMR and RGM: what CFR is compared with, beside RPM-Net, in the table of its paper."""
