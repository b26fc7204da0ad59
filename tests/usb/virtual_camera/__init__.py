"""A USB3 spike camera without hardware: one core, seen through umockdev's usbfs or over USB/IP.

It knows nothing of spiked: what it sends is built from the facts of the wire, so that it can bear witness.
"""
