"""The command line as its verbs share it: arguments, texts and files, whatever room a verb belongs to."""
