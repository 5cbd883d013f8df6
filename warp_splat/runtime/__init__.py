"""Threads, devices, processes and signals: what every computation runs on."""
