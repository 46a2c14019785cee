/* The functions that FMI 2 and FMI 3 share but for their prefix. Included where these are defined: FMI(name), the name
   with its prefix; OF_STATE(before, after), the name of a function of saved states; DESERIALIZED, that of the last one. */

EXPORTED FMI(Status) FMI(SetDebugLogging)(void *c, FMI(Boolean) on, size_t n, const FMI(String) categories[])
{
    (void)c; (void)on; (void)n; (void)categories;
    return FMI(OK);
}

static instance *made(const char *token)
{
    instance *m = token != NULL && strcmp(token, TOKEN) == 0 ? calloc(1, sizeof *m) : NULL;
    if (m != NULL) {
        begin(m);
    }
    return m;
}

EXPORTED void FMI(FreeInstance)(void *c) { free(c); }
EXPORTED FMI(Status) FMI(ExitInitializationMode)(void *c) { show_start(c); return FMI(OK); }
EXPORTED FMI(Status) FMI(Terminate)(void *c) { (void)c; return FMI(OK); }
EXPORTED FMI(Status) FMI(Reset)(void *c) { begin(c); return FMI(OK); }

EXPORTED FMI(Status) OF_STATE(Get, )(void *c, void **state)
{
    if (*state == NULL) {
        *state = calloc(1, sizeof(instance));
    }
    if (*state == NULL) {
        return FMI(Error);
    }
    memcpy(*state, c, sizeof(instance));
    return FMI(OK);
}

EXPORTED FMI(Status) OF_STATE(Set, )(void *c, void *state)
{
    memcpy(c, state, sizeof(instance));
    return FMI(OK);
}

EXPORTED FMI(Status) OF_STATE(Free, )(void *c, void **state)
{
    (void)c;
    free(*state);
    *state = NULL;
    return FMI(OK);
}

EXPORTED FMI(Status) OF_STATE(Serialized, Size)(void *c, void *state, size_t *size)
{
    (void)c; (void)state;
    *size = sizeof(instance);
    return FMI(OK);
}

EXPORTED FMI(Status) OF_STATE(Serialize, )(void *c, void *state, FMI(Byte) bytes[], size_t size)
{
    (void)c;
    if (size < sizeof(instance)) {
        return FMI(Error);
    }
    memcpy(bytes, state, sizeof(instance));
    return FMI(OK);
}

EXPORTED FMI(Status) DESERIALIZED(void *c, const FMI(Byte) bytes[], size_t size, void **state)
{
    if (size != sizeof(instance) || OF_STATE(Get, )(c, state) != FMI(OK)) {
        return FMI(Error);
    }
    memcpy(*state, bytes, sizeof(instance));
    return FMI(OK);
}
