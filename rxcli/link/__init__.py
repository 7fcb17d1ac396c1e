"""Link layer: from soft bits of packets to messages and files, and back to labels for transmitters.

Receiving::

    receiver = LinkReceiver(columns=20, payload_symbols=24)
    for soft in frames:                  # `FrameSoftBits`: soft bits of one frame or one burst
        for event in receiver.add(soft): # `Message` or `ReceivedObject`, each once, when it is complete
            ...
    receiver.finish()                    # decode the rest; again a list of events
    receiver.messages                    # every `Message` so far: kind, text, data
    receiver.progress                    # every incomplete file, `ObjectProgress`: blocks, share received

`Collector` does this for `FrameResult`s: `collector.add(result)` returns the result with `messages` and `objects`
filled in (`ReceiverOptions.soft_bits` must be set), `collector.finish(last_result)` adds `progress` and `link_notes`,
and `rxcli.link.saving.save_object` writes a file.

Sending: `message(...)` and `file_object(...)` return a `Sending`. Its `labels(first, n, N, C)` are the labels for the
transmitter, and `rxcli.link.encoder.packet_slots_of` converts them to slots. `simulate` uses the same functions.

The log-likelihood ratio of a bit is ln p(1)/p(0) everywhere, 0 if nothing is known. Burst numbers count through a clip;
`epoch` changes where the count may have jumped (a new photo, a lost clock). This package knows nothing of pixels.
"""
