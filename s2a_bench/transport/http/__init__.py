"""HTTP/JSON in the OpenAI chat/completions dialect with Server-Sent Events, in three variants."""
