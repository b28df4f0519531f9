"""UR robots as they are built: lengths, and bytes on their wires. Driver and virtual controller share it."""
