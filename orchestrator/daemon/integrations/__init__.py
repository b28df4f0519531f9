"""Connections of other systems: the station's API for programs, SiLA 2 and MADSci."""
