
void PREFIX_reset(PREFIX_state *state)
{
    begin(state);
}

int PREFIX_step(PREFIX_state *state, ARGUMENTSconst double y[NY], PREFIX_estimates *estimates)
{
    double heard[NY];
    double said[ROW];
    const double *after;
    int i, failed;
NOTHING    failed = advance(state, INPUT, y, heard, said);
    if (failed) {
        return failed;
    }
    after = latest_of(state)->memory;
    copy(estimates->states, after + AT_POSTERIOR, NX);
    copy(estimates->parameters, after + AT_THETA, NQ);
    for (i = 0; i < NX; i++) {
        estimates->state_deviations[i] = sqrt(fmax(said[AT_COVARIANCE + i * (NX + 1)], 0.0));
    }
    for (i = 0; i < NQ; i++) {
        estimates->parameter_deviations[i] = sqrt(fmax(after[AT_SPREAD + i * (NQ + 1)], 0.0));
    }
    for (i = 0; i < NY; i++) {
        estimates->innovations[i] = isnan(heard[i]) ? NAN : said[AT_INNOVATION + i];
    }
    estimates->nis = said[AT_NIS];
    estimates->residual = said[AT_RESIDUAL];
    return 0;
}
