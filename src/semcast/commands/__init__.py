"""One module a verb: ``add_arguments(parser)`` declares options, ``run(arguments)`` returns the exit code."""
