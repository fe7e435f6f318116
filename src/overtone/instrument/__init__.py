"""What the microscope adds to the signals."""
