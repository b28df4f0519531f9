"""What any driver has to do, as tests that its author runs: derive a class in a test module of your own."""
