"""Reports: of runs, of conformance tests, of a site acceptance, and drawings of systems."""
