"""How to record data that this program can use: steps at the microscope, as a page.

The content lies in the TOML files of this folder, ``protocol.toml`` for what holds everywhere and one
file a vendor; the page in the terminal and ``docs/protocol.md`` are both written from it.
"""

from overtone.protocol.numbers import ProbeNumbers, probe_numbers, reference_probe
from overtone.protocol.page import NOT_VERIFIED, full_page, vendor_page
from overtone.protocol.records import Protocol, Step, Vendor, VendorStep, protocol, vendor, vendors

__all__ = [
    "NOT_VERIFIED",
    "ProbeNumbers",
    "Protocol",
    "Step",
    "Vendor",
    "VendorStep",
    "full_page",
    "probe_numbers",
    "protocol",
    "reference_probe",
    "vendor",
    "vendor_page",
    "vendors",
]
