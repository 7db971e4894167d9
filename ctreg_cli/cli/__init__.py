"""The command line: parse, compose, write; never compute."""
