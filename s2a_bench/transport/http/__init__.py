"""HTTP: our own server in three variants of OpenAI's dialect, and a client that speaks to other servers too."""
