"""Everything that touches hardware: protocol codecs, bus, IMU and camera drivers, the engine that owns them."""
