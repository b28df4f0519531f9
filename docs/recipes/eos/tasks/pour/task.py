"""An EOS task that pours."""

from eos.tasks.base_task import BaseTask


class Pour(BaseTask):
    """Pours with the device `pouring_station`."""

    async def _execute(
        self,
        devices: BaseTask.DevicesType,
        parameters: BaseTask.ParametersType,
        resources: BaseTask.ResourcesType,
    ) -> BaseTask.OutputType:
        result = devices["station"].pour(
            {
                "id": parameters["order_id"],
                "source": parameters["source"],
                "receiver": parameters["receiver"],
                "amount": f"{parameters['amount']} g",
                "tolerance": f"{parameters['tolerance']} g",
            }
        )
        return {"received": result["received_g"]}, resources, None
