"""Turn a trace into integers, and find facts about its steps that hold in every map."""
