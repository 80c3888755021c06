"""Published denoising networks, to compare the ST-LSTM with: FFDNet, KPN, TOFlow and FastDVDnet.

All see what the ST-LSTM's `video` sees: counts less the black level, in linear light, divided by constants of the
camera. Noise maps follow from the camera's parameters and the noisy frames (shot noise at the light that these show,
plus the variance of darks), never from the clean frames. Networks that expect display values get them by
`display_from_linear`, odd about black (`layers.displayed`). `width` scales the numbers of feature maps: 1 is the
published network, 1/8 suits a CPU. Batch normalisation is left out, as the released networks have it folded into their
convolutions.
"""
