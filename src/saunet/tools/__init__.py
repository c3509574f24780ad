"""Tools beside training: doctor, calibrate, prepare, benchmark."""
